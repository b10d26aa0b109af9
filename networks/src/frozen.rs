//! A low level that was learned before and is not trained any more.

use comic_experiment::{ACTION_SIZE, Network, PROPRIOCEPTION_SIZE, Transfer, TransferPrior};
use tch::{Device, Kind, Tensor, nn};

use crate::low_level::{self, LowLevel};
use crate::lstm::RecurrentState;
use crate::normaliser::normalise;
use crate::prior::StatePrior;

/// A frozen low level with its own frozen normaliser: from latents to actions. It reads proprioception as the environment
/// gives it. [`Exported`](crate::export::Exported) makes it from a file.
#[derive(Debug)]
pub struct FrozenLowLevel {
    low_level: Box<dyn LowLevel>,
    /// Mean and standard deviation of proprioception; `None` if it was learned on raw observations.
    normaliser: Option<[Tensor; 2]>,
    /// The prior that actions deviate from; `None` if they are latents.
    prior: Option<StatePrior>,
    /// Limit of each entry of a latent.
    latent_limit: f64,
    /// Size of its recurrent state.
    state_size: usize,
}

impl FrozenLowLevel {
    /// A low level with the sizes of `network`, and the store of its parameters, which have the names of an exported file.
    /// Set them and freeze the store before it acts. `prior` has the hidden sizes of the file's prior, if it has one.
    pub(crate) fn new(
        network: &Network,
        normalises: bool,
        prior: Option<&[usize]>,
        transfer: &Transfer,
    ) -> (nn::VarStore, Self) {
        let store = nn::VarStore::new(Device::Cpu);
        let (root, latent) = (store.root(), network.latent.size as i64);
        let path = &root / "low_level";
        let pose = [0.0; ACTION_SIZE];
        let config = low_level::Config { latent, proprioception: PROPRIOCEPTION_SIZE as i64, pose: &pose, network };
        let low_level = low_level::build(&path, &config);
        if network.final_std > 0.0 {
            // The file has it. Only the mean acts, so it is not used.
            let _ = path.zeros_no_train("scheduled_std", &[1]);
        }
        let (path, size) = (&root / "normaliser", [PROPRIOCEPTION_SIZE as i64]);
        let statistics =
            [path.zeros_no_train("proprioception_mean", &size), path.ones_no_train("proprioception_std", &size)];
        let normaliser = normalises.then_some(statistics);
        let prior = prior.map(|hidden| StatePrior::new(&(&root / "prior"), PROPRIOCEPTION_SIZE, network, hidden));
        let prior = prior.filter(|_| transfer.prior == TransferPrior::State);
        let latent_limit = transfer.latent_limit;
        (store, Self { low_level, normaliser, prior, latent_limit, state_size: network.state_size() })
    }

    /// Size of the recurrent state, 0 if there is none.
    pub fn state_size(&self) -> usize {
        self.state_size
    }

    /// Proprioception `[N, P]` as the low level reads it.
    pub fn normalise(&self, proprioception: &Tensor) -> Tensor {
        match &self.normaliser {
            Some([mean, std]) => normalise(proprioception, mean, std),
            None => proprioception.shallow_clone(),
        }
    }

    /// The derivatives `[N, A]` with respect to the policy's actions, for derivatives `[N, 56]` with respect to the commands that
    /// [`act`](Self::act) made of them. Later commands are held fixed, also where the low level is recurrent. They are 0 for a
    /// mixture, whose latent only chooses the component.
    ///
    /// # Errors
    /// libtorch fails.
    pub fn action_derivatives(
        &self,
        action: &Tensor,
        proprioception: &Tensor,
        state: &Tensor,
        derivatives: &Tensor,
    ) -> Result<Tensor, tch::TchError> {
        tch::with_grad(|| {
            let action = action.detach().set_requires_grad(true);
            let (command, _) = self.act(&action, proprioception, state);
            let along = (command * derivatives).sum(Kind::Float);
            // The mean of a mixture is that of its most likely component. libtorch would crash: it has nothing to go back through.
            if !along.requires_grad() {
                return Ok(action.zeros_like());
            }
            let mut found = Tensor::f_run_backward(&[along], &[&action], false, false)?;
            found.pop().ok_or_else(|| tch::TchError::Torch("no derivative".into()))
        })
    }

    /// The low level's mean action `[N, 56]` for the policy's actions `[N, Z]`, and its next recurrent state `[N, S]`. An action
    /// is a latent, or a deviation from the prior of the state; the latent is clamped. `proprioception` is `[N, P]`, not
    /// normalised; `state` is zero at an episode's first step.
    pub fn act(&self, action: &Tensor, proprioception: &Tensor, state: &Tensor) -> (Tensor, Tensor) {
        let proprioception = self.normalise(proprioception);
        let latent = match &self.prior {
            Some(prior) => prior.forward(&proprioception).sample(action),
            None => action.shallow_clone(),
        };
        let input = low_level::Input {
            intent: &latent.clamp(-self.latent_limit, self.latent_limit),
            proprioception: &proprioception,
            recurrent: RecurrentState { state, first: None },
        };
        let low_level::Output { action, state } = self.low_level.act(&input);
        (action.mode(), state)
    }
}
