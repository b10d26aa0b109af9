//! `comic-learner prior`: fits the prior p(z | s) of a low level to the latents of its encoder.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use comic_experiment::{PROPRIOCEPTION_SIZE, Transfer};
use comic_networks::export::{Exported, FittedPrior};
use comic_networks::{DiagonalGaussian, StatePrior};
use tch::nn::OptimizerConfig as _;
use tch::{Device, Kind, Tensor, nn};

use crate::error::{Error, Result};
use crate::tensors;

/// Share of the latents that the fit does not see, and that measure it.
const HELD_OUT: f64 = 0.1;
/// Fewest latents of a fit.
const FEWEST: i64 = 1000;
/// Latents of a gradient step.
const MINIBATCH: i64 = 2048;
/// Adam's learning rate at the beginning; it falls linearly to 0.
const LEARNING_RATE: f64 = 1e-3;
/// Gradient steps between two reports.
const REPORTED_STEPS: u32 = 250;
/// Seed of the parameters and of the minibatches.
const SEED: i64 = 1;

/// Fits the prior of the state to the latents that `comic-actor latents` wrote, and writes the low level with it.
#[derive(Args, Debug)]
pub struct Prior {
    /// The low level: a file of `comic-learner export --part low-level`, or `builtin`.
    #[arg(long, value_name = "FILE")]
    low_level: PathBuf,
    /// The latents: a file of `comic-actor latents`.
    #[arg(long, value_name = "FILE")]
    latents: PathBuf,
    /// The low level with its prior.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Hidden sizes of the prior.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "256,256")]
    #[arg(value_parser = clap::value_parser!(u16).range(1..=16384))]
    hidden: Vec<u16>,
    /// Gradient steps.
    #[arg(long, value_name = "N", default_value_t = 5000, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
}

impl Prior {
    /// Fits, writes, and says how much better than N(0, I) the prior predicts latents that it was not fitted to.
    ///
    /// # Errors
    /// [`Error::Configuration`] when a file cannot be used, a disk that fails.
    pub fn run(&self) -> Result<()> {
        let of = |path: &Path| format!("cannot use {}", path.display());
        let file = Exported::open_or_builtin(&self.low_level)
            .map_err(Error::from)
            .map_err(Error::within(of(&self.low_level)))?;
        let latents = Latents::read(&self.latents, &file).map_err(Error::within(of(&self.latents)))?;
        let hidden: Vec<usize> = self.hidden.iter().map(|size| usize::from(*size)).collect();
        let (store, prior) = fit(&file, &latents, hidden, self.steps)?;
        let (nats, standard_nats) = (prior.nats, prior.standard_nats);
        let file = file.with_prior(prior, &store).map_err(Error::from)?;
        std::fs::write(&self.out, &file.bytes).map_err(Error::file("write", &self.out))?;
        tracing::info!(out = %self.out.display(), nats, standard_nats, "wrote the low level with its prior");
        Ok(())
    }
}

/// Latents and the proprioception that they were drawn for, `[N, Z]` and `[N, P]`.
struct Latents {
    latent: Tensor,
    proprioception: Tensor,
}

impl Latents {
    /// Reads a file of `comic-actor latents`, which may come from anywhere.
    fn read(path: &Path, file: &Exported) -> Result<Self> {
        let wrong =
            |problem: String| Error::configuration(format!("{problem}: `comic-actor latents` writes such a file"));
        let bytes = std::fs::read(path).map_err(Error::file("read", path))?;
        let named = tensors::from_bytes(&bytes).map_err(|error| wrong(comic_proto::chain(&error)))?;
        let find = |name: &str, width: usize| {
            let tensor = named.iter().find(|(found, _)| found == name).map(|(_, tensor)| tensor.shallow_clone());
            let tensor = tensor.ok_or_else(|| wrong(format!("it has no tensor `{name}`")))?;
            let holds = tensor.kind() == Kind::Float && tensor.dim() == 2 && tensor.size()[1] == width as i64;
            if !holds || !bool::try_from(tensor.isfinite().all())? {
                let size = tensor.size();
                return Err(wrong(format!("`{name}` is not N × {width} finite float32 numbers, but {size:?}")));
            }
            Ok(tensor)
        };
        let network = &file.experiment.network;
        let (latent, proprioception) =
            (find("latent", network.latent.size)?, find("proprioception", comic_experiment::PROPRIOCEPTION_SIZE)?);
        let (rows, others) = (latent.size()[0], proprioception.size()[0]);
        if rows != others || rows < FEWEST {
            let problem = format!("it has {rows} latents and {others} states; at least {FEWEST} of each are needed");
            return Err(wrong(problem));
        }
        Ok(Self { latent, proprioception })
    }

    /// The rows of these indices.
    fn select(&self, index: &Tensor) -> Self {
        let select = |tensor: &Tensor| tensor.index_select(0, index);
        Self { latent: select(&self.latent), proprioception: select(&self.proprioception) }
    }
}

/// Maximises the likelihood of the latents.
fn fit(file: &Exported, latents: &Latents, hidden: Vec<usize>, steps: u32) -> Result<(nn::VarStore, FittedPrior)> {
    let frozen = file.freeze(&Transfer::default())?;
    tch::manual_seed(SEED);
    let store = nn::VarStore::new(Device::Cpu);
    let prior = StatePrior::new(&(store.root() / "prior"), PROPRIOCEPTION_SIZE, &file.experiment.network, &hidden);
    let mut adam = nn::Adam::default().build(&store, LEARNING_RATE)?;
    let rows = latents.latent.size()[0];
    let own = Latents {
        latent: latents.latent.shallow_clone(),
        proprioception: tch::no_grad(|| frozen.normalise(&latents.proprioception)),
    };
    let order = Tensor::randperm(rows, (Kind::Int64, Device::Cpu));
    let held_out = (rows as f64 * HELD_OUT) as i64;
    let (measured, fitted) = (own.select(&order.narrow(0, 0, held_out)), order.narrow(0, held_out, rows - held_out));
    let nats = |latents: &Latents| -prior.forward(&latents.proprioception).log_prob(&latents.latent).mean(Kind::Float);
    let measure = || tch::no_grad(|| nats(&measured)).double_value(&[]);
    let begun = Instant::now();
    for step in 0..steps {
        adam.set_lr(LEARNING_RATE * (1.0 - f64::from(step) / f64::from(steps)));
        let chosen = Tensor::randint(rows - held_out, [MINIBATCH], (Kind::Int64, Device::Cpu));
        adam.backward_step(&nats(&own.select(&fitted.index_select(0, &chosen))));
        if (step + 1).is_multiple_of(REPORTED_STEPS) {
            let seconds = begun.elapsed().as_secs_f32();
            tracing::info!(step = step + 1, of = steps, nats = measure(), seconds, "fitting");
        }
    }
    let standard = DiagonalGaussian { mean: measured.latent.zeros_like(), std: measured.latent.ones_like() };
    let standard_nats = (-standard.log_prob(&measured.latent)).mean(Kind::Float).double_value(&[]);
    let (latents, nats) = ((rows - held_out) as u64, measure());
    let fitted = FittedPrior { hidden, latents, nats: Some(nats), standard_nats: Some(standard_nats) };
    if !nats.is_finite() {
        return Err(Error::Diverged("the fit of the prior diverged: its likelihood is not finite".into()));
    }
    Ok((store, fitted))
}

#[cfg(test)]
mod tests {
    use comic_experiment::resolve;
    use comic_networks::export::{Part, Source};
    use comic_networks::{VmpoPolicy, to_safetensors};

    use super::*;

    /// The low level of a small untrained policy with a latent of two numbers.
    fn low_level() -> Exported {
        let fields = ["network.encoder=[8]", "network.mlp.hidden=[8]", "network.latent.size=2"];
        let experiment = resolve("tracking-mlp", &fields.map(String::from)).unwrap();
        let spec = comic_experiment::TaskSpec::new(&experiment, Vec::new()).unwrap();
        let store = nn::VarStore::new(Device::Cpu);
        VmpoPolicy::new(&store.root(), &spec, &experiment.network, &vec![0.0; spec.action]).unwrap();
        let parameters = to_safetensors(&store).unwrap();
        Exported::new(Part::LowLevel, &experiment, Source::default(), &parameters, None).unwrap()
    }

    /// z = s₀ + ½ N(0, 1) in the first entry, and N(3, 1) in the second.
    fn latents(rows: i64) -> Latents {
        let random = |width: i64| Tensor::randn([rows, width], (Kind::Float, Device::Cpu));
        let proprioception = random(comic_experiment::PROPRIOCEPTION_SIZE as i64);
        let first = proprioception.narrow(1, 0, 1) + random(1) * 0.5;
        Latents { latent: Tensor::cat(&[first, random(1) + 3.0], 1), proprioception }
    }

    #[test]
    fn the_fit_finds_the_distribution_of_latents_it_has_not_seen() {
        tch::manual_seed(2);
        let file = low_level();
        let (store, prior) = fit(&file, &latents(40_000), vec![32, 32], 800).unwrap();
        // The entropy of the two entries: ½ ln 2πe each, and ln ½ less for the first.
        let least = (2.0 * std::f64::consts::PI * std::f64::consts::E).ln() - std::f64::consts::LN_2;
        // Without the state the first entry has the variance 1.25.
        let without_state = least + std::f64::consts::LN_2 + 0.5 * 1.25_f64.ln();
        let middle = f64::midpoint(least, without_state);
        let (nats, standard_nats) = (prior.nats.unwrap(), prior.standard_nats.unwrap());
        assert!((least - 0.02..middle).contains(&nats), "{prior:?}: at least {least}, below {middle}");
        assert!(standard_nats > nats + 3.0, "{prior:?}");
        let with = file.with_prior(prior.clone(), &store).unwrap();
        assert_eq!(with.spec.prior, Some(prior));
        let again = Exported::read(with.bytes.clone()).unwrap();
        assert_eq!(again.spec, with.spec);
        let transfer = Transfer { prior: comic_experiment::TransferPrior::State, ..Transfer::default() };
        assert!(again.freeze(&transfer).is_ok());
        assert!(file.freeze(&transfer).unwrap_err().to_string().contains("comic-learner prior"));
    }

    #[test]
    fn latents_of_another_low_level_are_refused() {
        let file = low_level();
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("latents.safetensors");
        let refused = |named: &[(&str, Tensor)]| {
            let named: Vec<_> = named.iter().map(|(name, tensor)| (name.to_string(), tensor.shallow_clone())).collect();
            std::fs::write(&path, tensors::to_bytes(&named).unwrap()).unwrap();
            Latents::read(&path, &file).err().unwrap().to_string()
        };
        let zeros = |rows: i64, width: i64| Tensor::zeros([rows, width], (Kind::Float, Device::Cpu));
        assert!(refused(&[("latent", zeros(2000, 2))]).contains("no tensor `proprioception`"));
        assert!(refused(&[("latent", zeros(2000, 3)), ("proprioception", zeros(2000, 205))]).contains("`latent`"));
        let few = refused(&[("latent", zeros(10, 2)), ("proprioception", zeros(10, 205))]);
        assert!(few.contains("at least 1000"), "{few}");
        let infinite = refused(&[("latent", zeros(2000, 2).log()), ("proprioception", zeros(2000, 205))]);
        assert!(infinite.contains("finite"), "{infinite}");
        std::fs::write(&path, b"nothing").unwrap();
        assert!(Latents::read(&path, &file).err().unwrap().to_string().contains("comic-actor latents"));
    }
}
