//! Records the resets and actions of an environment, and plays them to the physics alone.

use std::sync::Arc;

use comic_tasks::raw_physics::{PhysicsState, RawPhysics};
use comic_tasks::{Achievement, Environment, Episode, Simulated, Step};
use parking_lot::Mutex;

/// Physics steps in a control step of 0.03 s.
pub(super) const SUBSTEPS: usize = 6;

/// Resets, with the states after them, and actions, in order.
#[derive(Debug, Default)]
struct Recording {
    /// A state after a reset, or none for a step, which takes the next action.
    events: Vec<Option<PhysicsState>>,
    actions: Vec<f32>,
    width: usize,
}

/// A shared handle of a recording.
#[derive(Clone, Debug, Default)]
pub(super) struct Tape(Arc<Mutex<Recording>>);

impl Tape {
    /// Plays what was recorded since the last call, and returns the number of steps.
    pub(super) fn play(&self, floor: &mut RawPhysics) -> usize {
        let recording = std::mem::take(&mut *self.0.lock());
        let mut actions = recording.actions.chunks_exact(recording.width.max(1));
        let mut steps = 0;
        for event in recording.events {
            match event {
                Some(state) => floor.reset_to(&state),
                None => {
                    steps += 1;
                    if let Some(action) = actions.next() {
                        floor.step(action, SUBSTEPS);
                    }
                }
            }
        }
        steps
    }
}

/// An environment that records.
#[derive(Debug)]
pub(super) struct Recorded {
    environment: Box<dyn Simulated>,
    tape: Tape,
}

impl Recorded {
    pub(super) fn new(environment: Box<dyn Simulated>) -> (Self, Tape) {
        let tape = Tape::default();
        (Self { environment, tape: tape.clone() }, tape)
    }

    fn record(&self, write: impl FnOnce(&mut Recording)) {
        // No other thread holds the lock while the environment is stepped, so it costs about twenty nanoseconds.
        write(&mut self.tape.0.lock());
    }
}

impl Environment for Recorded {
    fn reset(&mut self) {
        self.environment.reset();
        self.record(|recording| recording.events.push(Some(PhysicsState::of(self.environment.as_ref()))));
    }
    fn reset_to(&mut self, clip: usize, start: usize) -> Result<(), comic_tasks::Error> {
        self.environment.reset_to(clip, start)
    }
    fn step(&mut self, action: &[f32]) -> Step {
        self.record(|recording| {
            recording.events.push(None);
            recording.actions.extend_from_slice(action);
            recording.width = action.len();
        });
        self.environment.step(action)
    }
    fn observe(&self, proprioception: &mut [f32], task: &mut [f32]) {
        self.environment.observe(proprioception, task);
    }
    fn draw(&mut self, image: &mut [u8]) -> Result<(), comic_tasks::Error> {
        self.environment.draw(image)
    }
    fn episode(&self) -> Episode {
        self.environment.episode()
    }
    fn record_gradients(&mut self) -> Result<(), comic_tasks::Error> {
        self.environment.record_gradients()
    }
    fn take_gradients(&mut self) -> Vec<[f32; 56]> {
        self.environment.take_gradients()
    }
    fn achievement(&self) -> Achievement {
        self.environment.achievement()
    }
    fn servo_action(&self, action: &mut [f32]) {
        self.environment.servo_action(action);
    }
}
