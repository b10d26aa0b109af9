//! Mean and standard deviation of the observations, for the normaliser.

use anyhow::{Context as _, Result};
use comic_experiment::TaskSpec;
use comic_networks::NormaliserStatistics;
use comic_proto::Field;
use comic_replay::Batch;
use tch::{Kind, Tensor};

/// Of proprioception, which every task shares, and of each task's own observation.
#[derive(Debug)]
pub struct ObservationStatistics {
    proprioception: Statistics,
    /// By the task's name.
    tasks: Vec<(String, Statistics)>,
}

impl ObservationStatistics {
    /// Nothing seen yet.
    pub fn new(spec: &TaskSpec) -> Self {
        let of_task = |name: &String| (name.clone(), Statistics::new(spec.task as i64));
        Self {
            proprioception: Statistics::new(spec.proprioception as i64),
            tasks: spec.tasks.iter().map(|task| of_task(&task.name)).collect(),
        }
    }

    /// Rows seen.
    pub fn count(&self) -> f64 {
        self.proprioception.count()
    }

    /// Adds the observations of a batch whose unrolls are of these tasks.
    ///
    /// A row that begins an episode counts only where a step follows it: the others may be padding.
    pub fn absorb(&mut self, batch: &Batch, tasks: &[usize]) {
        let length = batch.layout.shape().length;
        let (valid, first) = (batch.f32(Field::Valid), batch.f32(Field::First));
        let is_seen = |unroll: usize, t: usize| {
            first[unroll * (length + 1) + t] == 0.0 || (t < length && valid[unroll * length + t] == 1.0)
        };
        let observations =
            |field: Field| Tensor::from_slice(batch.f32(field)).reshape([-1, batch.layout.width(field) as i64]);
        let (proprioception, task) = (observations(Field::Proprioception), observations(Field::Task));
        for (index, (_, statistics)) in self.tasks.iter_mut().enumerate() {
            let rows: Vec<i64> = (0..tasks.len())
                .filter(|unroll| tasks[*unroll] == index)
                .flat_map(|unroll| (0..=length).map(move |t| (unroll, t)))
                .filter(|(unroll, t)| is_seen(*unroll, *t))
                .map(|(unroll, t)| (unroll * (length + 1) + t) as i64)
                .collect();
            let rows = Tensor::from_slice(&rows);
            self.proprioception.absorb(&proprioception.index_select(0, &rows));
            statistics.absorb(&task.index_select(0, &rows));
        }
    }

    /// As the normaliser takes them.
    ///
    /// # Errors
    /// When libtorch refuses.
    pub fn to_normaliser(&self) -> Result<NormaliserStatistics> {
        let floats =
            |tensors: Vec<Tensor>| Vec::<f32>::try_from(Tensor::cat(&tensors, 0)).context("cannot read the statistics");
        let (mean, std) = self.proprioception.mean_and_std();
        let (task_means, task_stds) = self.tasks.iter().map(|(_, statistics)| statistics.mean_and_std()).unzip();
        Ok(NormaliserStatistics {
            proprioception_mean: floats(vec![mean])?,
            proprioception_std: floats(vec![std])?,
            task_mean: floats(task_means)?,
            task_std: floats(task_stds)?,
        })
    }

    /// As tensors, for a checkpoint.
    pub fn state(&self) -> Vec<(String, Tensor)> {
        self.named().flat_map(|(name, statistics)| statistics.state(&name)).collect()
    }

    /// Restores what [`state`](Self::state) gave, and takes it out of `tensors`.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn restore(&mut self, tensors: &mut Vec<(String, Tensor)>) -> Result<()> {
        let find = |wanted: &str| tensors.iter().find(|(name, _)| name == wanted).map(|(_, tensor)| tensor.copy());
        let named = std::iter::once((PROPRIOCEPTION.to_string(), &mut self.proprioception))
            .chain(self.tasks.iter_mut().map(|(task, statistics)| (of_task(task), statistics)));
        for (name, statistics) in named {
            statistics.restore(&name, find).with_context(|| format!("the checkpoint's {name} do not fit the task"))?;
        }
        tensors.retain(|(name, _)| !name.starts_with(PREFIX));
        Ok(())
    }

    fn named(&self) -> impl Iterator<Item = (String, &Statistics)> {
        let tasks = self.tasks.iter().map(|(task, statistics)| (of_task(task), statistics));
        std::iter::once((PROPRIOCEPTION.to_string(), &self.proprioception)).chain(tasks)
    }
}

/// How the names of statistics begin in a checkpoint.
const PREFIX: &str = "statistics.";
const PROPRIOCEPTION: &str = "statistics.proprioception";

fn of_task(task: &str) -> String {
    format!("statistics.task.{task}")
}

/// Running sums over rows, in float64.
#[derive(Debug)]
pub struct Statistics {
    count: f64,
    sum: Tensor,
    squares: Tensor,
}

impl Statistics {
    /// Nothing seen yet, for rows `width` wide.
    pub fn new(width: i64) -> Self {
        let zeros = || Tensor::zeros([width], (Kind::Double, tch::Device::Cpu));
        Self { count: 0.0, sum: zeros(), squares: zeros() }
    }

    /// Adds rows `[…, width]`.
    pub fn absorb(&mut self, rows: &Tensor) {
        let width = self.sum.size()[0];
        let rows = rows.reshape([-1, width]).to_device(tch::Device::Cpu).to_kind(Kind::Double);
        self.count += rows.size()[0] as f64;
        self.sum += rows.sum_dim_intlist([0i64].as_slice(), false, Kind::Double);
        self.squares += rows.square().sum_dim_intlist([0i64].as_slice(), false, Kind::Double);
    }

    /// Rows seen.
    pub fn count(&self) -> f64 {
        self.count
    }

    /// Mean and standard deviation `[width]`, float32. A component that never moves gets 1, so that it stays harmless.
    pub fn mean_and_std(&self) -> (Tensor, Tensor) {
        let count = self.count.max(1.0);
        let mean = &self.sum / count;
        let variance = (&self.squares / count - mean.square()).clamp_min(0.0);
        let std = variance.sqrt();
        let moving = std.gt(1e-4);
        let std = std.where_self(&moving, &Tensor::ones_like(&std));
        (mean.to_kind(Kind::Float), std.to_kind(Kind::Float))
    }

    /// As tensors, for a checkpoint.
    pub fn state(&self, name: &str) -> Vec<(String, Tensor)> {
        vec![
            (format!("{name}.count"), Tensor::from(self.count)),
            (format!("{name}.sum"), self.sum.copy()),
            (format!("{name}.squares"), self.squares.copy()),
        ]
    }

    /// Restores what [`state`](Self::state) gave; `None` when a tensor is missing or of another shape.
    pub fn restore(&mut self, name: &str, find: impl Fn(&str) -> Option<Tensor>) -> Option<()> {
        let sum = find(&format!("{name}.sum"))?;
        let squares = find(&format!("{name}.squares"))?;
        let count = f64::try_from(find(&format!("{name}.count"))?).ok()?;
        if sum.size() != self.sum.size() || squares.size() != self.squares.size() {
            return None;
        }
        *self = Self { count, sum, squares };
        Some(())
    }
}
