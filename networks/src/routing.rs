//! Routes each unroll through the network of its task.
//!
//! In joint training every task has its own encoder and value function, and a batch has unrolls of all tasks. A
//! [`Routing`] has the task of each unroll; [`PerTask`] has one network per task.
//!
//! To act, the rows are grouped by task, and networks of tasks without rows do not run ([`Routing::grouped`]).
//!
//! In the learner, shapes must not depend on the mix of tasks: other shapes need other memory, and a graph compiler
//! would compile again ([`Routing::blocked`]). So unrolls are sorted by task into blocks of one task each, and each
//! block goes through the network of its task. There are a few more blocks than full blocks would need. With two tasks
//! and blocks of an eighth of the batch, this takes 9/8 of the products of one network. Running every network over
//! every unroll would take twice the products.

use tch::{Device, Tensor};

use crate::layers::{Mlp, forward_chosen};

/// The task of each unroll, or of each environment.
#[derive(Debug)]
pub struct Routing(Option<Routed>);

#[derive(Debug)]
struct Routed {
    /// The task of each unroll, `[B]` int64.
    tasks: Tensor,
    plan: Plan,
}

#[derive(Debug)]
enum Plan {
    /// For each task, the indices of its unrolls, int64.
    Groups(Vec<Tensor>),
    Blocks(Blocks),
}

/// Unrolls sorted by task into slots. If a task does not fill its last block, the rest of its slots is padding.
#[derive(Debug)]
struct Blocks {
    /// The unroll in each slot, `[blocks · size]` int64. A padding slot has unroll 0; its output is not read.
    slots: Tensor,
    /// The slot of each unroll, `[B]` int64.
    places: Tensor,
    /// The task of each block.
    tasks: BlockTasks,
    /// Number of unrolls per block.
    size: i64,
}

/// The task of each block, in host memory or on the device.
#[derive(Debug)]
enum BlockTasks {
    /// In host memory: each block runs through its own network, and no parameter is copied.
    Host(Vec<usize>),
    /// On the device, `[blocks]` int64: the compiled program does not depend on the mix of tasks.
    Device(Tensor),
}

/// Number of blocks of a batch; each further task adds one block.
const BLOCKS: usize = 8;

impl Routing {
    /// For one task. If there are several networks, all rows go through the first.
    pub fn single() -> Self {
        Self(None)
    }

    /// To act: `tasks` has the task of each environment, below `count`.
    pub fn grouped(tasks: &[usize], count: usize) -> Self {
        if count < 2 {
            return Self::single();
        }
        let groups = (0..count).map(|task| index_tensor(indices_of(tasks, task), Device::Cpu)).collect();
        Self(Some(Routed { tasks: index_tensor(tasks.iter().copied(), Device::Cpu), plan: Plan::Groups(groups) }))
    }

    /// To learn: `tasks` has the task of each unroll, below `count`. All shapes depend only on the number of unrolls
    /// and the number of tasks. On devices other than the CPU, the operations do too.
    pub fn blocked(tasks: &[usize], count: usize, device: Device) -> Self {
        if count < 2 {
            return Self::single();
        }
        let size = tasks.len().div_ceil(BLOCKS).max(1);
        let blocks = tasks.len().div_ceil(size) + count - 1;
        let (mut slots, mut places, mut of_block) = (Vec::new(), vec![0; tasks.len()], Vec::new());
        for task in 0..count {
            for unroll in indices_of(tasks, task) {
                places[unroll] = slots.len();
                slots.push(unroll);
            }
            // Padding up to the end of the block.
            slots.resize(slots.len().next_multiple_of(size), 0);
            of_block.resize(slots.len() / size, task);
        }
        slots.resize(blocks * size, 0);
        of_block.resize(blocks, 0);
        let blocks = Blocks {
            slots: index_tensor(slots, device),
            places: index_tensor(places, device),
            tasks: match device {
                Device::Cpu => BlockTasks::Host(of_block),
                _ => BlockTasks::Device(index_tensor(of_block, device)),
            },
            size: size as i64,
        };
        Self(Some(Routed { tasks: index_tensor(tasks.iter().copied(), device), plan: Plan::Blocks(blocks) }))
    }

    /// A copy that shares the tensors.
    pub fn shallow_clone(&self) -> Self {
        Self(self.0.as_ref().map(|Routed { tasks, plan }| {
            let plan = match plan {
                Plan::Groups(groups) => Plan::Groups(groups.iter().map(Tensor::shallow_clone).collect()),
                Plan::Blocks(Blocks { slots, places, tasks, size }) => Plan::Blocks(Blocks {
                    slots: slots.shallow_clone(),
                    places: places.shallow_clone(),
                    tasks: match tasks {
                        BlockTasks::Host(tasks) => BlockTasks::Host(tasks.clone()),
                        BlockTasks::Device(tasks) => BlockTasks::Device(tasks.shallow_clone()),
                    },
                    size: *size,
                }),
            };
            Routed { tasks: tasks.shallow_clone(), plan }
        }))
    }

    /// The task of each unroll, `[B]` int64; `None` for one task.
    pub fn tasks(&self) -> Option<&Tensor> {
        self.0.as_ref().map(|routed| &routed.tasks)
    }
}

/// The indices of the unrolls of `task`.
fn indices_of(tasks: &[usize], task: usize) -> impl Iterator<Item = usize> {
    tasks.iter().enumerate().filter(move |(_, of)| **of == task).map(|(index, _)| index)
}

/// An int64 tensor of these indices.
fn index_tensor(values: impl IntoIterator<Item = usize>, device: Device) -> Tensor {
    let values: Vec<i64> = values.into_iter().map(|value| value as i64).collect();
    Tensor::from_slice(&values).to_device(device)
}

/// One network per task. The networks have the same sizes except for their inputs; a network reads only the last
/// entries of the input.
#[derive(Debug)]
pub(crate) struct PerTask {
    networks: Vec<Mlp>,
}

impl PerTask {
    /// `networks` has at least one network.
    pub(crate) fn new(networks: Vec<Mlp>) -> Self {
        Self { networks }
    }

    /// From `[N, I]` to `[N, O]`. The N rows are unroll by unroll; I is the width of the widest input.
    pub(crate) fn forward(&self, input: &Tensor, routing: &Routing) -> Tensor {
        match (&self.networks[..], &routing.0) {
            ([network], _) => network.forward(input),
            (networks, None) => networks[0].forward(&own(&networks[0], input)),
            (networks, Some(routed)) => match &routed.plan {
                Plan::Groups(groups) => by_group(networks, groups, input),
                Plan::Blocks(blocks) => by_block(networks, blocks, input),
            },
        }
    }
}

/// The part of an input that the network reads.
fn own(network: &Mlp, input: &Tensor) -> Tensor {
    let width = network.input();
    input.narrow(1, input.size()[1] - width, width)
}

/// Runs the rows of each task through its network.
fn by_group(networks: &[Mlp], groups: &[Tensor], input: &Tensor) -> Tensor {
    let present = || networks.iter().zip(groups).filter(|(_, rows)| rows.numel() > 0);
    let outputs: Vec<Tensor> =
        present().map(|(network, rows)| network.forward(&own(network, &input.index_select(0, rows)))).collect();
    let rows: Vec<&Tensor> = present().map(|(_, rows)| rows).collect();
    // The outputs are sorted by task; this restores the order of the rows.
    Tensor::cat(&outputs, 0).index_select(0, &Tensor::cat(&rows, 0).argsort(0, false))
}

/// Runs each block through the network of its task.
fn by_block(networks: &[Mlp], blocks: &Blocks, input: &Tensor) -> Tensor {
    let (unrolls, width) = (blocks.places.size()[0], input.size()[1]);
    let count = blocks.slots.size()[0] / blocks.size;
    let sorted = input.reshape([unrolls, -1]).index_select(0, &blocks.slots).reshape([count, -1, width]);
    let output = match &blocks.tasks {
        BlockTasks::Host(tasks) => {
            let of_block = |(task, rows): (&usize, Tensor)| networks[*task].forward(&own(&networks[*task], &rows));
            let outputs: Vec<Tensor> = tasks.iter().zip(sorted.unbind(0)).map(of_block).collect();
            Tensor::cat(&outputs, 0)
        }
        BlockTasks::Device(tasks) => forward_chosen(networks, tasks, &sorted).flatten(0, 1),
    };
    let width = output.size()[1];
    output.reshape([count * blocks.size, -1]).index_select(0, &blocks.places).reshape([-1, width])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tch::Kind;

    use super::*;

    fn numbers(tensor: &Tensor) -> Vec<usize> {
        Vec::<i64>::try_from(tensor).unwrap().into_iter().map(|number| number as usize).collect()
    }

    fn blocks(tasks: &[usize], count: usize) -> Blocks {
        match Routing::blocked(tasks, count, Device::Cpu).0 {
            Some(Routed { plan: Plan::Blocks(blocks), .. }) => blocks,
            other => panic!("{other:?}"),
        }
    }

    proptest! {
        #[test]
        fn every_unroll_has_its_own_slot_in_a_block_of_its_task_and_shapes_do_not_depend_on_the_mix(
            (count, tasks) in (2_usize..5).prop_flat_map(|count| (Just(count), prop::collection::vec(0..count, 1..40))),
        ) {
            let Blocks { slots, places, tasks: of_blocks, size } = blocks(&tasks, count);
            let even = blocks(&vec![0; tasks.len()], count);
            prop_assert_eq!((slots.size(), size), (even.slots.size(), even.size));
            let of_blocks = match of_blocks {
                BlockTasks::Host(tasks) => tasks,
                BlockTasks::Device(tasks) => numbers(&tasks),
            };
            prop_assert_eq!(of_blocks.len() * size as usize, slots.size()[0] as usize);
            let (slots, places) = (numbers(&slots), numbers(&places));
            for (unroll, task) in tasks.iter().enumerate() {
                prop_assert_eq!(slots[places[unroll]], unroll);
                prop_assert_eq!(of_blocks[places[unroll] / size as usize], *task);
            }
        }
    }

    #[test]
    fn two_tasks_in_a_batch_of_128_cost_an_eighth_more() {
        let tasks: Vec<usize> = (0..128).map(|unroll| unroll % 2).collect();
        assert_eq!(blocks(&tasks, 2).slots.size(), [144]);
    }

    /// libtorch has one generator per process, so tests that seed it must not run at the same time.
    static GENERATOR: std::sync::Mutex<()> = std::sync::Mutex::new(());

    /// Two networks with different inputs.
    fn networks(store: &tch::nn::VarStore) -> PerTask {
        let networks = [5_i64, 3].into_iter().enumerate().map(|(task, input)| {
            let path = store.root() / task;
            let torso = crate::layers::Torso::new(&path, input, &[8, 7]);
            let head = crate::linear::Linear::new(&(&path / "head"), torso.output(), 4, 1.0);
            let linear_path = path.var("linear_path", &[4, input], tch::nn::Init::Randn { mean: 0.0, stdev: 1.0 });
            Mlp::new(torso, head, Some(crate::linear::Matrix::new(linear_path)))
        });
        PerTask::new(networks.collect())
    }

    #[test]
    fn grouped_and_blocked_unrolls_go_through_the_network_of_their_task() {
        let _guard = GENERATOR.lock().unwrap();
        tch::manual_seed(1);
        let store = tch::nn::VarStore::new(Device::Cpu);
        let per_task = networks(&store);
        let (tasks, steps) = ([0, 1, 1, 0, 1, 0, 0, 1, 1, 1, 0], 3);
        let input = Tensor::randn([11 * steps, 5], (Kind::Float, Device::Cpu));
        // In a batch the entries before a task's own observation are 0.
        for (unroll, task) in tasks.iter().enumerate() {
            if *task == 1 {
                let _ = input.narrow(0, unroll as i64 * steps, steps).narrow(1, 0, 2).zero_();
            }
        }
        let blocked = per_task.forward(&input, &Routing::blocked(&tasks, 2, Device::Cpu));
        for (unroll, task) in tasks.iter().enumerate() {
            let own = |tensor: &Tensor| tensor.narrow(0, unroll as i64 * steps, steps);
            let network = &per_task.networks[*task];
            let expected = network.forward(&super::own(network, &own(&input)));
            assert!((own(&blocked) - &expected).abs().max().double_value(&[]) < 1e-5, "unroll {unroll}");
        }
        // The method for devices other than the CPU.
        let mut on_device = blocks(&tasks, 2);
        if let BlockTasks::Host(tasks) = &on_device.tasks {
            on_device.tasks = BlockTasks::Device(index_tensor(tasks.iter().copied(), Device::Cpu));
        }
        let chosen = by_block(&per_task.networks, &on_device, &input);
        assert!((&chosen - &blocked).abs().max().double_value(&[]) < 1e-5);
        let parameters = store.trainable_variables();
        let gradients =
            |output: &Tensor| Tensor::run_backward(&[output.square().sum(Kind::Float)], &parameters, true, false);
        for (chosen, blocked) in gradients(&chosen).iter().zip(gradients(&blocked)) {
            assert!(
                (chosen - &blocked).abs().max().double_value(&[])
                    < 1e-4 * (1.0 + blocked.abs().max().double_value(&[]))
            );
        }
        // To act there is one row per environment.
        let rows = input.reshape([11, steps, 5]).select(1, 0);
        let grouped = per_task.forward(&rows, &Routing::grouped(&tasks, 2));
        let same = blocked.reshape([11, steps, 4]).select(1, 0);
        assert!((grouped - same).abs().max().double_value(&[]) < 1e-5);
    }

    #[test]
    fn grouping_skips_tasks_without_rows() {
        let _guard = GENERATOR.lock().unwrap();
        tch::manual_seed(1);
        let store = tch::nn::VarStore::new(Device::Cpu);
        let per_task = networks(&store);
        let input = Tensor::randn([4, 5], (Kind::Float, Device::Cpu));
        let output = per_task.forward(&input, &Routing::grouped(&[1, 1, 1, 1], 2));
        let expected = per_task.networks[1].forward(&input.narrow(1, 2, 3));
        assert_eq!((output - expected).abs().max().double_value(&[]), 0.0);
    }
}
