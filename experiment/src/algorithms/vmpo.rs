//! V-MPO (Song et al., 2020), the algorithm of the paper's tracking experiments.

use serde::{Deserialize, Serialize};

use super::{AlgorithmParameters, Rest};
use crate::fault::{AT_LEAST_ONE, Fault, NOT_NEGATIVE, POSITIVE, ensure, not_negative, positive};
use crate::tasks::{TaskName, TerminationError};

/// V-MPO.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Vmpo {
    /// γ (S).
    pub discount: f64,
    /// ε_η: limit of the E-step (S).
    pub epsilon_eta: f64,
    /// ε_μ: limit on the mean (S).
    pub epsilon_mean: f64,
    /// ε_Σ: limit on the covariance (S: MLP and LSTM; 1e-3 for mixture and product).
    pub epsilon_std: f64,
    /// ε_discrete: limit on a mixture's weights (S).
    pub epsilon_discrete: f64,
    /// η at the start (S).
    pub initial_temperature: f64,
    /// α_μ at the start (S).
    pub initial_alpha_mean: f64,
    /// α_Σ at the start (S).
    pub initial_alpha_std: f64,
    /// α_discrete at the start (S).
    pub initial_alpha_discrete: f64,
    /// Share of the valid steps that the E-step imitates: those with the best advantages (S: the top half).
    pub top_fraction: f64,
    /// In joint training each task has its own temperature and its own best steps, because advantages of different tasks
    /// have different scales (D). Without this, one E-step ranks the steps of all tasks.
    pub temperature_per_task: bool,
    /// Updates, each on one batch, between two renewals of the target network. Actors act with the target network (V).
    pub target_period: u64,
    /// Gradient steps on each batch (V: 1).
    pub gradient_steps: usize,
    /// Unrolls in a gradient step. The number must divide the batch (V: the whole batch).
    pub minibatch_unrolls: usize,
    /// λ of the return: 1 is the paper's n-step return; less is GAE's mixture of returns (D).
    pub lambda: f64,
    /// Entropy bonus (V: none).
    pub entropy: f64,
    /// κ: weight of a term of the policy loss whose expected gradient is 0 in the first gradient step on a batch (D). It
    /// cancels the part of the gradient that only imitates exploration noise, so an estimate from the same steps has less
    /// variance. 0 is off (V). A mixture has none.
    pub control_variate: f64,
    /// Weight w of the simulator's derivative of the reward with respect to the actions (D): the policy loss has the term
    /// −w/η · mean over valid steps of derivative · mean action. The actors compute the derivative, as the section `gradient`
    /// of the task says; ball-catch has none. With a frozen low level it goes on through the low level, to the latent. 0 is off.
    pub action_gradient: f64,
    /// Weight of the value loss (D).
    pub value_weight: f64,
    /// Rows at the start of an unroll that only build up the recurrent state of the value function. No loss uses them (D).
    pub value_burn_in: usize,
}

impl Default for Vmpo {
    fn default() -> Self {
        Self {
            discount: 0.95,
            epsilon_eta: 0.1,
            epsilon_mean: 0.1,
            epsilon_std: 1e-5,
            epsilon_discrete: 1e-3,
            initial_temperature: 1.0,
            initial_alpha_mean: 1.0,
            initial_alpha_std: 1.0,
            initial_alpha_discrete: 1.0,
            top_fraction: 0.5,
            temperature_per_task: true,
            target_period: 100,
            gradient_steps: 1,
            minibatch_unrolls: 128,
            lambda: 1.0,
            entropy: 0.0,
            control_variate: 0.0,
            action_gradient: 0.0,
            value_weight: 1.0,
            value_burn_in: 0,
        }
    }
}

impl AlgorithmParameters for Vmpo {
    fn check(&self, rest: &Rest<'_>) -> Result<(), Fault> {
        let Rest { unroll, network, tracking, transfers, .. } = rest;
        ensure("vmpo.discount", self.discount, (0.0..1.0).contains(&self.discount), "must be in [0, 1)")?;
        for (field, number) in [
            ("vmpo.epsilon_eta", self.epsilon_eta),
            ("vmpo.epsilon_mean", self.epsilon_mean),
            ("vmpo.epsilon_std", self.epsilon_std),
            ("vmpo.epsilon_discrete", self.epsilon_discrete),
            ("vmpo.initial_temperature", self.initial_temperature),
            ("vmpo.initial_alpha_mean", self.initial_alpha_mean),
            ("vmpo.initial_alpha_std", self.initial_alpha_std),
            ("vmpo.initial_alpha_discrete", self.initial_alpha_discrete),
        ] {
            ensure(field, number, positive(number), POSITIVE)?;
        }
        let holds = self.top_fraction > 0.0 && self.top_fraction <= 1.0;
        ensure("vmpo.top_fraction", self.top_fraction, holds, "must be in (0, 1]")?;
        ensure("vmpo.target_period", self.target_period, self.target_period > 0, AT_LEAST_ONE)?;
        ensure("vmpo.gradient_steps", self.gradient_steps, self.gradient_steps > 0, AT_LEAST_ONE)?;
        let (batch, minibatch) = (unroll.batch, self.minibatch_unrolls);
        let holds = minibatch > 0 && batch.is_multiple_of(minibatch);
        ensure("vmpo.minibatch_unrolls", minibatch, holds, format!("must divide unroll.batch, {batch}"))?;
        ensure("vmpo.lambda", self.lambda, (0.0..=1.0).contains(&self.lambda), "must be in [0, 1]")?;
        for (field, weight) in [
            ("vmpo.entropy", self.entropy),
            ("vmpo.action_gradient", self.action_gradient),
            ("vmpo.control_variate", self.control_variate),
            ("vmpo.value_weight", self.value_weight),
        ] {
            ensure(field, weight, not_negative(weight), NOT_NEGATIVE)?;
        }
        let burn_in = self.value_burn_in;
        let holds = burn_in == 0 || burn_in < unroll.length;
        ensure("vmpo.value_burn_in", burn_in, holds, "must be less than unroll.length")?;
        let holds = burn_in == 0 || !network.value_lstm.is_empty();
        let remedy = "must be 0 without a recurrent value function; set network.value_lstm, or leave this 0";
        ensure("vmpo.value_burn_in", burn_in, holds, remedy)?;
        let weight = self.action_gradient;
        let has = |wanted| rest.tasks.contains(&wanted);
        let linear = tracking.termination_error == TerminationError::DmControl;
        let others = [TaskName::GetUp, TaskName::GoToTarget, TaskName::Gaps, TaskName::Walls];
        let differentiable = if has(TaskName::Tracking) { linear } else { others.into_iter().any(has) };
        let remedy = "must be 0 with ball-catch alone, and with another tracking.termination_error than dm-control";
        ensure("vmpo.action_gradient", weight, weight == 0.0 || differentiable, remedy)?;
        let holds = self.control_variate == 0.0 || *transfers || network.components() == 1;
        let remedy = "must be 0 with network.low_level = \"mixture\", whose KL has no closed form";
        ensure("vmpo.control_variate", self.control_variate, holds, remedy)
    }

    fn share(&mut self, ranks: usize) -> Result<(), Fault> {
        let minibatch = self.minibatch_unrolls;
        let holds = minibatch.is_multiple_of(ranks);
        ensure("vmpo.minibatch_unrolls", minibatch, holds, format!("must be a multiple of {ranks}"))?;
        self.minibatch_unrolls /= ranks;
        Ok(())
    }

    fn unread(&self, _: &Rest<'_>) -> Vec<&'static str> {
        vec!["replay"]
    }

    fn has_low_level(&self) -> bool {
        true
    }

    fn state_size(&self, rest: &Rest<'_>) -> usize {
        if rest.transfers { 0 } else { rest.network.state_size() }
    }

    fn versions_in(&self, updates: u64) -> Option<u64> {
        // A check of the document refuses a period of 0.
        Some(updates.div_ceil(self.target_period.max(1)))
    }

    fn reads_action_gradient(&self) -> bool {
        self.action_gradient > 0.0
    }
}
