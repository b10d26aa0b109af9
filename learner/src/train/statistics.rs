//! Mean and standard deviation of the observations, for the normaliser.

use comic_experiment::TaskSpec;
use comic_networks::NormaliserStatistics;
use comic_proto::Field;
use comic_replay::Batch;
use tch::{Kind, Tensor};

use crate::error::{Error, Result};
use crate::world::World;

/// The statistics of proprioception, which all tasks share, and of each task's own observation.
#[derive(Debug)]
pub struct ObservationStatistics {
    /// Rows of the batches seen, padding included; float64.
    rows: Tensor,
    proprioception: Statistics,
    /// By the task's name.
    tasks: Vec<(String, Statistics)>,
}

impl ObservationStatistics {
    /// Nothing seen yet.
    pub fn new(spec: &TaskSpec) -> Self {
        let of_task = |name: &String| (name.clone(), Statistics::new(spec.task as i64));
        Self {
            rows: Tensor::from(0.0),
            proprioception: Statistics::new(spec.proprioception as i64),
            tasks: spec.tasks.iter().map(|task| of_task(&task.name)).collect(),
        }
    }

    /// Rows of the batches seen. A count of rows, not of steps: the difference is one row in an unroll, and padding.
    pub fn rows(&self) -> f64 {
        self.rows.double_value(&[])
    }

    /// Whether there are no statistics yet for one of these tasks.
    pub fn lacks(&self, tasks: &[usize]) -> bool {
        tasks.iter().any(|task| self.tasks.get(*task).is_some_and(|(_, statistics)| statistics.count() == 0.0))
    }

    /// Adds the observations of this batch, and of those of all other ranks.
    ///
    /// # Errors
    /// When another rank is lost.
    pub fn absorb(&mut self, batch: &Batch, world: &World) -> Result<()> {
        let mut added = self.emptied();
        added.count(batch);
        world.sum(added.sums())?;
        for (sum, added) in self.sums().zip(added.sums()) {
            *sum += &*added;
        }
        Ok(())
    }

    /// The same without observations.
    fn emptied(&self) -> Self {
        let tasks = self.tasks.iter().map(|(task, statistics)| (task.clone(), statistics.emptied())).collect();
        Self { rows: self.rows.zeros_like(), proprioception: self.proprioception.emptied(), tasks }
    }

    fn sums(&mut self) -> impl Iterator<Item = &mut Tensor> {
        let of_tasks = self.tasks.iter_mut().flat_map(|(_, statistics)| statistics.sums());
        std::iter::once(&mut self.rows).chain(self.proprioception.sums()).chain(of_tasks)
    }

    /// Counts the observations of a batch.
    ///
    /// If there are several tasks, a row that begins an episode counts only if a step follows it, because it may be padding.
    fn count(&mut self, batch: &Batch) {
        let tasks = batch.tasks();
        let length = batch.layout.shape().length;
        let (valid, first) = (batch.f32(Field::Valid), batch.f32(Field::First));
        let alone = self.tasks.len() == 1;
        let is_seen = |unroll: usize, t: usize| {
            alone || first[unroll * (length + 1) + t] == 0.0 || (t < length && valid[unroll * length + t] == 1.0)
        };
        self.rows += first.len() as f64;
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

    /// In the form that the normaliser takes.
    ///
    /// # Errors
    /// When libtorch refuses.
    pub fn to_normaliser(&self) -> Result<NormaliserStatistics> {
        let floats = |tensors: Vec<Tensor>| Vec::<f32>::try_from(Tensor::cat(&tensors, 0));
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
        let rows = (ROWS.to_string(), self.rows.copy());
        std::iter::once(rows).chain(self.named().flat_map(|(name, statistics)| statistics.state(&name))).collect()
    }

    /// Restores what [`state`](Self::state) gave, and takes it out of `tensors`.
    ///
    /// # Errors
    /// When a tensor is missing or of another shape.
    pub fn restore(&mut self, tensors: &mut Vec<(String, Tensor)>) -> Result<()> {
        let find = |wanted: &str| tensors.iter().find(|(name, _)| name == wanted).map(|(_, tensor)| tensor.copy());
        let rows = find(ROWS).and_then(|rows| f64::try_from(rows).ok()).map(Tensor::from);
        self.rows = rows.ok_or_else(|| Error::Checkpoint(format!("the checkpoint has no {ROWS}")))?;
        let named = std::iter::once((PROPRIOCEPTION.to_string(), &mut self.proprioception))
            .chain(self.tasks.iter_mut().map(|(task, statistics)| (of_task(task), statistics)));
        for (name, statistics) in named {
            let misfit = || Error::Checkpoint(format!("the checkpoint's {name} do not fit the task"));
            statistics.restore(&name, find).ok_or_else(misfit)?;
        }
        tensors.retain(|(name, _)| !name.starts_with(PREFIX));
        Ok(())
    }

    fn named(&self) -> impl Iterator<Item = (String, &Statistics)> {
        let tasks = self.tasks.iter().map(|(task, statistics)| (of_task(task), statistics));
        std::iter::once((PROPRIOCEPTION.to_string(), &self.proprioception)).chain(tasks)
    }
}

/// The beginning of the statistics' names in a checkpoint.
const PREFIX: &str = "statistics.";
const ROWS: &str = "statistics.rows";
const PROPRIOCEPTION: &str = "statistics.proprioception";

fn of_task(task: &str) -> String {
    format!("statistics.task.{task}")
}

/// Running sums over rows, in float64.
#[derive(Debug)]
pub struct Statistics {
    count: Tensor,
    sum: Tensor,
    squares: Tensor,
}

impl Statistics {
    /// Nothing seen yet, for rows `width` wide.
    pub fn new(width: i64) -> Self {
        let zeros = || Tensor::zeros([width], (Kind::Double, tch::Device::Cpu));
        Self { count: Tensor::from(0.0), sum: zeros(), squares: zeros() }
    }

    fn emptied(&self) -> Self {
        Self::new(self.sum.size()[0])
    }

    fn sums(&mut self) -> impl Iterator<Item = &mut Tensor> {
        [&mut self.count, &mut self.sum, &mut self.squares].into_iter()
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
        self.count.double_value(&[])
    }

    /// Mean and standard deviation, `[width]` each, float32. A component that never changes gets deviation 1, so that it is
    /// not divided by 0.
    pub fn mean_and_std(&self) -> (Tensor, Tensor) {
        let count = self.count().max(1.0);
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
            (format!("{name}.count"), self.count.copy()),
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
        *self = Self { count: Tensor::from(count), sum, squares };
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use comic_experiment::{Experiment, TaskPart, resolve};
    use comic_proto::v1::UnrollHeader;
    use comic_proto::{UnrollBuffer, UnrollLayout, UnrollShape};

    use super::*;
    use crate::observe::metrics_file::{MetricsFile, Position};
    use crate::observe::window::{Rows, Window};

    /// Two tasks of one clip each.
    fn spec() -> TaskSpec {
        let part = |name: &str| TaskPart { name: name.into(), observation: 1, clips: 1, max_reward: 1.0 };
        TaskSpec {
            proprioception: 1,
            task: 1,
            action: 1,
            reward_terms: vec!["reward".into()],
            clips: vec!["walk".into(), "get-up".into()],
            tasks: vec![part("tracking"), part("get-up")],
            ..TaskSpec::default()
        }
    }

    /// Unrolls of three steps. Tracking's observations are 1, 2, 3, 2; those of getting up are 10, 30, and then padding.
    fn batch(spec: &TaskSpec) -> Batch {
        let mut experiment = resolve("tracking-mlp", &["unroll.length=3".into()]).unwrap();
        experiment.network.latent.size = 1;
        let layout = Arc::new(UnrollLayout::new(UnrollShape::new(spec, &experiment)));
        let unroll = |observations: [f32; 4], task: u32, padded: bool| {
            let mut unroll = UnrollBuffer::new(&layout);
            for (t, observation) in observations.into_iter().enumerate() {
                unroll.row_mut(Field::Proprioception, t)[0] = observation;
                unroll.row_mut(Field::Task, t)[0] = observation;
                unroll.set_clip(t, task);
            }
            unroll.row_mut(Field::Valid, 0)[0] = 1.0;
            for t in 1..3 {
                unroll.row_mut(Field::Valid, t)[0] = if padded { 0.0 } else { 1.0 };
                unroll.row_mut(Field::First, t + 1)[0] = if padded { 1.0 } else { 0.0 };
            }
            (UnrollHeader { task, ..UnrollHeader::default() }, unroll.into_bytes())
        };
        let unrolls = [unroll([1.0, 2.0, 3.0, 2.0], 0, false), unroll([10.0, 30.0, 99.0, 99.0], 1, true)];
        Batch::assemble(layout.clone(), unrolls).unwrap()
    }

    #[test]
    fn every_task_has_its_own_mean_without_padding() {
        let spec = spec();
        let mut statistics = ObservationStatistics::new(&spec);
        assert!(statistics.lacks(&[1]));
        statistics.absorb(&batch(&spec), &World::alone()).unwrap();
        let normaliser = statistics.to_normaliser().unwrap();
        assert_eq!(normaliser.task_mean, [2.0, 20.0]);
        assert!((normaliser.proprioception_mean[0] - 8.0).abs() < 1e-5, "{normaliser:?}");
        assert_eq!(statistics.rows(), 8.0, "padding is counted as rows");
        assert!(!statistics.lacks(&[0, 1]));
    }

    #[test]
    fn the_moments_of_batches_of_different_clips_are_those_of_all_rows() {
        // A long batch of a clip with small numbers, a short one of a clip with large ones.
        let rows: [&[f32]; 2] = [&[1.0, 2.0, 3.0, 2.0, 1.5, 2.5], &[100.0, 140.0]];
        let mut statistics = Statistics::new(1);
        for rows in rows {
            statistics.absorb(&Tensor::from_slice(rows).reshape([-1, 1]));
        }
        let all = Tensor::from_slice(&rows.concat());
        let (mean, std) = statistics.mean_and_std();
        assert!((mean.double_value(&[0]) - all.mean(Kind::Double).double_value(&[])).abs() < 1e-5);
        assert!((std.double_value(&[0]) - all.to_kind(Kind::Double).std(false).double_value(&[])).abs() < 1e-5);
    }

    #[test]
    fn a_checkpoint_restores_them() {
        let spec = spec();
        let mut statistics = ObservationStatistics::new(&spec);
        statistics.absorb(&batch(&spec), &World::alone()).unwrap();
        let mut state = statistics.state();
        state.push(("policy".into(), Tensor::from(1.0)));
        let mut restored = ObservationStatistics::new(&spec);
        restored.restore(&mut state).unwrap();
        assert_eq!(restored.to_normaliser().unwrap(), statistics.to_normaliser().unwrap());
        assert_eq!((restored.rows(), state.len()), (8.0, 1), "other tensors stay");
        let error = restored.restore(&mut Vec::new()).unwrap_err().to_string();
        assert!(error.contains("statistics.rows"), "{error}");
    }

    #[test]
    fn the_metrics_count_every_tasks_steps_and_padding() {
        let (spec, run) = (spec(), tempfile::tempdir().unwrap());
        let mut metrics = MetricsFile::open(run.path(), &Experiment::default(), &spec).unwrap();
        let rows = |environment_steps, padding| Rows { rows: 3, environment_steps, padding };
        let mut window = Window::default();
        assert_eq!(window.count_rows(&batch(&spec), &spec), [rows(3, 0), rows(1, 1)]);
        let position = Position { environment_steps: 4, updates: 1, ..Position::default() };
        let mut accounting = comic_replay::AccountingByTask::default();
        accounting.tasks.insert("get-up".into(), comic_replay::TaskAccounting { trained: 7, ..Default::default() });
        let line = metrics.write(position, &window, accounting, serde_json::Map::new(), None);
        let line: serde_json::Value = serde_json::from_str(&line).unwrap();
        assert_eq!(line["tasks"]["get-up"]["accounting"]["trained"], 7);
        assert_eq!(line["tasks"]["tracking"]["environment_steps"], 3);
        assert_eq!(line["tasks"]["get-up"]["environment_steps"], 1);
        // Its second row is the episode's last observation, and no padding.
        assert_eq!(line["tasks"]["get-up"]["padding_share"], 1.0 / 3.0);
        assert_eq!(line["tasks"]["tracking"]["padding_share"], 0.0);
    }
}
