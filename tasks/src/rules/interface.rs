//! The interface of the tasks without a reference.

use std::fmt::Debug;

use comic_experiment::Vision;
use rand_pcg::Pcg64;

use super::stage::Stage;
use crate::achievement::Achievement;
use crate::environment::MAX_REWARD_TERMS;
use crate::error::Error;
use crate::gradient::RewardDerivative;
use crate::humanoid::observation::Number;

/// How an episode begins, the reward of a step, when the humanoid fails, and what an episode achieved. All environments
/// share the rules.
pub(crate) trait Rules: Debug + Send + Sync + 'static {
    /// What one environment keeps from step to step.
    type State: Debug + Default + Send;

    /// A simulation in the task's arena, or in one of its arenas.
    ///
    /// # Errors
    /// The arena cannot be built.
    fn stage(&self, random: &mut Pcg64) -> Result<Stage, Error>;

    /// Draws an episode and sets the simulation to its first state.
    fn begin(&self, stage: &mut Stage, state: &mut Self::State, random: &mut Pcg64);

    /// The result of the control step that was just simulated.
    fn judge(&self, stage: &mut Stage, state: &mut Self::State, random: &mut Pcg64) -> Verdict;

    /// What the episode has achieved so far. `failed` says whether it ended in failure. After a divergence the stage's
    /// positions mean nothing, and the environment takes the success away.
    fn achievement(&self, stage: &Stage, state: &Self::State, failed: bool) -> Achievement;

    /// Writes the task observation.
    fn observe<T: Number>(&self, stage: &Stage, state: &Self::State, out: &mut [T]);

    /// Length of an episode, s.
    fn time_limit(&self) -> f64;

    /// Length of an episode whose start was drawn for training, s. Evaluations last [`time_limit`](Self::time_limit).
    fn training_time_limit(&self) -> f64 {
        self.time_limit()
    }

    /// δ of the derivative of the coming rewards with respect to the actions; `None` in a task without one.
    fn gradient_decay(&self) -> Option<f64> {
        None
    }

    /// The derivative of the reward of the control step that was just simulated with respect to the state after it.
    fn differentiate(&self, _: &Stage, _: &Self::State) -> RewardDerivative {
        RewardDerivative::ZERO
    }

    /// Position of the target on the floor, x and y, m; `None` in a task without a marked target.
    fn target(&self, _: &Self::State) -> Option<[f64; 2]> {
        None
    }

    /// How camera images are drawn.
    fn vision(&self) -> Vision {
        Vision::Off
    }
}

/// Rules that dm_control has, too. Its recorded episodes can be replayed with them.
pub(crate) trait Recorded: Rules {
    /// The entries of dm_control's dictionary besides the body's observations.
    fn observation(&self, stage: &Stage, state: &Self::State) -> Vec<(&'static str, Vec<f64>)>;

    /// The recorded quantities besides the observations.
    fn quantities(&self, stage: &Stage, state: &Self::State) -> Vec<(&'static str, Vec<f64>)>;
}

/// The result of a control step, before the time limit is checked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Verdict {
    pub(crate) reward_terms: [f64; MAX_REWARD_TERMS],
    pub(crate) failed: bool,
}

impl Verdict {
    /// A reward with one term.
    pub(crate) fn of(reward: f64, failed: bool) -> Self {
        let mut reward_terms = [0.0; MAX_REWARD_TERMS];
        reward_terms[0] = reward;
        Self { reward_terms, failed }
    }
}
