//! A frozen low level between the policy's action and the simulator.

use super::*;
use crate::forward_pass::{Actuated, LowLevelShape};

/// Entries of a command: fewer than those of an action.
const COMMANDS: usize = 1;

/// Acts as [`Plain`]. Its low level counts the steps of the episode in its state, and commands a hundredth of the count.
#[derive(Debug, Default)]
struct WithLowLevel {
    policy: Plain,
    /// The actions of each pass.
    actions: Vec<Vec<f32>>,
    /// What it was asked the derivatives of.
    actuated: Vec<Actuated>,
}

impl ForwardPass for WithLowLevel {
    fn load(&mut self, parameters: &[u8]) -> Result<(), Error> {
        self.policy.load(parameters)
    }
    fn forward(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        self.policy.forward(batch)
    }
    fn low_level(&self) -> Option<LowLevelShape> {
        Some(LowLevelShape { command: COMMANDS, state: 1 })
    }
    fn actuate(&mut self, batch: &mut ActingBatch) -> Result<(), Error> {
        self.actions.push(batch.action.clone());
        batch.low_level_state.iter_mut().for_each(|steps| *steps += 1.0);
        for (command, steps) in batch.command.iter_mut().zip(&batch.low_level_state) {
            *command = steps / 100.0;
        }
        Ok(())
    }
    fn action_derivatives(&mut self, actuated: Actuated) -> Result<Vec<f32>, Error> {
        let found = actuated.derivatives.chunks(56).map(|row| if row[0] == 5.0 { 1e9 } else { 10.0 * row[0] });
        let found = found.flat_map(|value| [value; 3]).collect();
        self.actuated.push(actuated);
        Ok(found)
    }
}

#[test]
fn the_simulator_gets_the_low_levels_command_and_the_unroll_the_policys_action() {
    let layout = layout(9);
    let mut worker = Worker::new(vec![Counter::new(&[4])], WithLowLevel::default(), Arc::clone(&layout), 0, 3).unwrap();
    worker.adopt(&directive(0)).unwrap();
    let unrolls = worker.unroll(&|| false, &Progress::default()).unwrap().unwrap();
    let rows = Rows { layout: &layout, payload: &unrolls[0].payload };
    for t in (0..9).filter(|t| rows.one(Field::Valid, *t) == 1.0) {
        assert_eq!(rows.row(Field::Action, t), worker.forward.actions[t], "row {t}");
        // The observation after a step names its command. The low level's state begins anew with each episode.
        let (_, step) = rows.place(t);
        assert_eq!(rows.one(Field::Task, t + 1), (step + 1) as f32 / 100.0, "row {t}");
    }
}

#[test]
fn the_low_level_gets_the_derivatives_with_what_it_read_at_each_transition() {
    let shape = UnrollShape { action_gradient: 3, ..*layout(6).shape() };
    let layout = Arc::new(UnrollLayout::new(shape));
    // Two transitions, the first episode's last observation, and three transitions.
    let environment = Counter { derivatives: 5, ..Counter::new(&[2, 9]) };
    let mut worker = Worker::new(vec![environment], WithLowLevel::default(), Arc::clone(&layout), 0, 3).unwrap();
    worker.adopt(&directive(0)).unwrap();
    let unrolls = worker.unroll(&|| false, &Progress::default()).unwrap().unwrap();
    let rows = Rows { layout: &layout, payload: &unrolls[0].payload };
    let Actuated { steps, action, proprioception, low_level_state, derivatives } = &worker.forward.actuated[0];
    let transitions = [0, 1, 3, 4, 5];
    assert_eq!(*steps, 5);
    assert_eq!(*action, transitions.map(|t| rows.row(Field::Action, t)).concat());
    assert_eq!(*proprioception, transitions.map(|t| rows.row(Field::Proprioception, t)).concat());
    // Steps since the episode began, before the low level acts.
    assert_eq!(*low_level_state, [0.0, 1.0, 0.0, 1.0, 2.0]);
    let first: Vec<f32> = derivatives.chunks(56).map(|row| row[0]).collect();
    assert_eq!(first, [1.0, 2.0, 3.0, 4.0, 5.0]);
    // Ten times the command's, and nothing where that is more than the wire takes.
    let written: Vec<f32> = (0..6).map(|t| rows.one(Field::ActionGradient, t)).collect();
    assert_eq!(written, [10.0, 20.0, 0.0, 30.0, 40.0, 0.0]);
}

#[test]
fn one_by_one_every_environment_has_its_own_low_level_state() {
    let lengths = [vec![3], vec![5]];
    let counters = || lengths.iter().map(|lengths| Counter::new(lengths)).collect::<Vec<_>>();
    let layout = layout(12);
    let mut together = Worker::new(counters(), WithLowLevel::default(), Arc::clone(&layout), 0, 3).unwrap();
    let alone = crate::forward_pass::OneByOne::new(WithLowLevel::default(), layout.shape());
    let mut alone = Worker::new(counters(), alone, Arc::clone(&layout), 0, 3).unwrap();
    together.adopt(&directive(0)).unwrap();
    alone.adopt(&directive(0)).unwrap();
    let payloads = |unrolls: Option<Vec<FinishedUnroll>>| {
        unrolls.unwrap().into_iter().map(|unroll| unroll.payload).collect::<Vec<_>>()
    };
    let one = payloads(together.unroll(&|| false, &Progress::default()).unwrap());
    assert_eq!(one, payloads(alone.unroll(&|| false, &Progress::default()).unwrap()));
}
