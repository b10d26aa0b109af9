//! From an experiment to its task. [`comic_experiment::for_each_task`] lists the tasks; each implements [`BuildTask`]
//! for its parameters, in its own file.

use std::sync::Arc;

use comic_clips::Catalogue;
use comic_experiment::{Experiment, TaskName, TaskSpec, for_each_task};

use crate::environment::Task;
use crate::error::{Error, unknown_observation};
use crate::joint::JointTask;

/// A task's parameters, from which the task is built.
pub(crate) trait BuildTask {
    /// # Errors
    /// Clips that are missing or cannot be used, or an arena that cannot be built.
    fn build(&self, context: &Context<'_>) -> Result<Arc<dyn Task>, Error>;
}

/// What a task needs besides its parameters.
pub(crate) struct Context<'a> {
    pub(crate) experiment: &'a Experiment,
    pub(crate) catalogue: &'a Catalogue,
    task: TaskName,
}

impl Context<'_> {
    /// The task's sizes and names.
    ///
    /// # Errors
    /// [`Error::Observation`]: the tracking task does not have an observation that the experiment names.
    pub(crate) fn spec(&self) -> Result<TaskSpec, Error> {
        TaskSpec::of_task(self.experiment, self.task, clip_names(self.catalogue)).map_err(unknown_observation)
    }
}

/// The task of an experiment, or its joint tasks. Tracking follows the catalogue's clips. Other tasks can start in poses of
/// the clips.
///
/// # Errors
/// [`Error`]: clips that are missing or cannot be used.
pub fn build(experiment: &Experiment, catalogue: &Catalogue) -> Result<Arc<dyn Task>, Error> {
    let one = |task| build_one(&Context { experiment, catalogue, task });
    if experiment.joint.is_empty() {
        return one(experiment.task);
    }
    catalogue.check_joint(experiment)?;
    let spec = TaskSpec::new(experiment, clip_names(catalogue)).map_err(unknown_observation)?;
    let tasks = experiment.tasks().into_iter().map(|(task, probability)| Ok((one(task)?, probability)));
    Ok(Arc::new(JointTask::new(spec, tasks.collect::<Result<_, Error>>()?)))
}

macro_rules! build_one {
    ($($(#[$description:meta])* $task:ident, $section:ident, $name:literal;)*) => {
        fn build_one(context: &Context<'_>) -> Result<Arc<dyn Task>, Error> {
            match context.task {
                $(TaskName::$task => context.experiment.$section.build(context),)*
            }
        }
    };
}

for_each_task!(build_one);

fn clip_names(catalogue: &Catalogue) -> Vec<String> {
    catalogue.entries().iter().map(|entry| entry.name.clone()).collect()
}
