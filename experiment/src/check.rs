//! Finds values that parse but mean nothing. Every rule refuses NaN.

use crate::clips::{ClipSource, SUBSETS};
use crate::document::Experiment;
use crate::fault::{AT_LEAST_ONE, Fault, NOT_NEGATIVE, POSITIVE, ensure, not_negative, positive};
use crate::network::{InitialPose, Network, Prior};
use crate::settings::{Actor, Budget, LONGEST_UNROLL, Learner, Optimiser, Unroll};
use crate::tasks::{TaskName, Vision};
use crate::transfer::Transfer;

/// The squared ratio of two float32 numbers overflows with a smaller deviation. The wire refuses a smaller one, too.
const SMALLEST_STD: f64 = 1e-6;
const AT_LEAST_STD: &str = "must be at least 1e-6";
/// With a larger deviation an action is only noise. The wire's limit is a thousand times as large.
const LARGEST_STD: f64 = 1e3;
const AT_MOST_STD: &str = "must be at most 1000";
/// A latent beyond this is a typing error: an encoder's latents are near N(0, I).
const LARGEST_LATENT: f64 = 1e3;

/// The first fault, in the order of the document.
pub(crate) fn check(experiment: &Experiment) -> Result<(), Fault> {
    ensure("clips", &experiment.clips, !experiment.clips.is_empty(), "name at least one clip source")?;
    joint(experiment)?;
    experiment.clips.iter().enumerate().try_for_each(|(index, source)| clips(index, source))?;
    TaskName::ALL.into_iter().try_for_each(|task| experiment.parameters(task).check(task.section()))?;
    transfer(experiment)?;
    network(&experiment.network)?;
    optimiser(&experiment.optimiser)?;
    unroll(&experiment.unroll)?;
    actor(&experiment.actor)?;
    together(experiment)?;
    algorithm(experiment)?;
    learner(&experiment.learner)?;
    budget(&experiment.budget)
}

fn joint(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { task, joint, network, .. } = experiment;
    for (index, complement) in joint.iter().enumerate() {
        let field = |name: &str| format!("joint.{index}.{name}");
        let earlier = joint[..index].iter().any(|other| other.task == complement.task);
        let new = complement.task != *task && !earlier;
        ensure(&field("task"), complement.task, new, "must be a task that is not named already")?;
        let probability = complement.probability;
        ensure(&field("probability"), probability, probability > 0.0 && probability < 1.0, "must be between 0 and 1")?;
    }
    if joint.is_empty() {
        return Ok(());
    }
    let sum: f64 = joint.iter().map(|complement| complement.probability).sum();
    ensure(
        "joint",
        sum,
        sum < 1.0,
        "the sum of the probabilities must be less than 1; the experiment's `task` has the remaining probability",
    )?;
    for (task, _) in experiment.tasks() {
        let Some((name, vision)) = experiment.parameters(task).vision() else { continue };
        task.section().ensure(name, vision, vision == Vision::Off, "must be off in joint training")?;
    }
    let lstm = &network.value_lstm;
    ensure(
        "network.value_lstm",
        lstm,
        lstm.is_empty(),
        "must be empty in joint training, where value functions are feed-forward",
    )
}

fn clips(index: usize, source: &ClipSource) -> Result<(), Fault> {
    let field = |name: &str| format!("clips.{index}.{name}");
    let ClipSource { source, subset, ids: _, start_step, end_step, weight } = source;
    ensure(&field("source"), source, !source.is_empty(), "must be a file or builtin:NAME")?;
    if let Some(subset) = subset {
        let remedy = format!("must be one of {}", SUBSETS.join(", "));
        ensure(&field("subset"), subset, SUBSETS.contains(&subset.as_str()), remedy)?;
    }
    if let Some(end_step) = end_step {
        ensure(&field("end_step"), end_step, end_step > start_step, "must exceed start_step")?;
    }
    ensure(&field("weight"), weight, not_negative(*weight), NOT_NEGATIVE)
}

/// Fields of a transfer, and fields that make no sense beside a frozen low level.
fn transfer(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { transfer, network, joint, .. } = experiment;
    let Transfer { low_level: _, sha256, latent_limit, mean_scale, prior: _ } = transfer;
    let holds = sha256.is_empty() || (sha256.len() == 64 && sha256.bytes().all(|byte| byte.is_ascii_hexdigit()));
    ensure("transfer.sha256", sha256, holds, "must be empty, or 64 hexadecimal digits")?;
    let in_range = |number: &f64| positive(*number) && *number <= LARGEST_LATENT;
    ensure("transfer.latent_limit", latent_limit, in_range(latent_limit), "must be positive, at most 1000")?;
    let holds = *mean_scale == 0.0 || in_range(mean_scale);
    ensure("transfer.mean_scale", mean_scale, holds, "must be 0, which chooses it, or positive, at most 1000")?;
    if !transfer.is_on() {
        return Ok(());
    }
    ensure("joint", joint.len(), joint.is_empty(), "must be empty with transfer.low_level")?;
    let pose = network.initial_pose;
    let holds = pose == InitialPose::MidRange;
    ensure("network.initial_pose", pose, holds, "must be \"mid-range\" with transfer.low_level")
}

fn network(network: &Network) -> Result<(), Fault> {
    let primitives = &network.primitives;
    for (field, sizes, may_be_empty) in [
        ("network.encoder", &network.encoder, false),
        ("network.mlp.hidden", &network.mlp.hidden, false),
        ("network.lstm.units", &network.lstm.units, false),
        ("network.primitives.torso", &primitives.torso, false),
        ("network.primitives.gate", &primitives.gate, false),
        ("network.value", &network.value, false),
        ("network.value_lstm", &network.value_lstm, true),
    ] {
        let holds = (may_be_empty || !sizes.is_empty()) && sizes.iter().all(|size| (1..=16384).contains(size));
        ensure(field, sizes, holds && sizes.len() <= 64, "must be one or more layers of 1 to 16384 units")?;
    }
    let (count, hidden) = (primitives.count, primitives.hidden);
    ensure("network.primitives.count", count, (2..=64).contains(&count), "must be 2 to 64")?;
    ensure("network.primitives.hidden", hidden, (1..=16384).contains(&hidden), "must be 1 to 16384 units")?;
    let Network { clip_embedding, initial_std, min_std, policy_head_scale, latent, .. } = network;
    ensure("network.clip_embedding", clip_embedding, (1..=4096).contains(clip_embedding), "must be 1 to 4096")?;
    let features = network.image_features;
    ensure("network.image_features", features, (1..=4096).contains(&features), "must be 1 to 4096")?;
    ensure("network.min_std", min_std, positive(*min_std) && *min_std >= SMALLEST_STD, AT_LEAST_STD)?;
    let holds = positive(*initial_std) && initial_std > min_std;
    ensure("network.initial_std", initial_std, holds, "must exceed network.min_std")?;
    ensure("network.initial_std", initial_std, *initial_std <= LARGEST_STD, AT_MOST_STD)?;
    let final_std = network.final_std;
    let holds = final_std == 0.0 || (*min_std..=*initial_std).contains(&final_std);
    let remedy = "must be 0, which is off, or from network.min_std to network.initial_std";
    ensure("network.final_std", final_std, holds, remedy)?;
    ensure("network.policy_head_scale", policy_head_scale, not_negative(*policy_head_scale), NOT_NEGATIVE)?;
    let bare = network.low_level.acts_without_bottleneck();
    let (least, remedy) = if bare { (0, "must be at most 4096") } else { (1, "must be 1 to 4096") };
    ensure("network.latent.size", latent.size, (least..=4096).contains(&latent.size), remedy)?;
    ensure("network.latent.beta", latent.beta, not_negative(latent.beta), NOT_NEGATIVE)?;
    ensure("network.latent.min_std", latent.min_std, positive(latent.min_std), POSITIVE)?;
    let holds = positive(latent.initial_std) && latent.initial_std > latent.min_std;
    ensure("network.latent.initial_std", latent.initial_std, holds, "must exceed network.latent.min_std")?;
    match &latent.prior {
        Prior::Standard => Ok(()),
        Prior::State { hidden } => {
            let holds = (1..=16).contains(&hidden.len()) && hidden.iter().all(|size| (1..=16384).contains(size));
            let remedy = "must be 1 to 16 layers of 1 to 16384 units";
            ensure("network.latent.prior.state.hidden", hidden, holds, remedy)?;
            let remedy = "must be positive with a network.latent.prior of the state";
            ensure("network.latent.size", latent.size, latent.size > 0, remedy)
        }
        Prior::Ar1 { alpha } => {
            ensure("network.latent.prior.ar1.alpha", alpha, (0.0..1.0).contains(alpha), "must be in [0, 1)")
        }
    }
}

fn optimiser(optimiser: &Optimiser) -> Result<(), Fault> {
    for (field, number) in [
        ("optimiser.learning_rate", optimiser.learning_rate),
        ("optimiser.multiplier_learning_rate", optimiser.multiplier_learning_rate),
        ("optimiser.epsilon", optimiser.epsilon),
    ] {
        ensure(field, number, positive(number), POSITIVE)?;
    }
    let share = optimiser.final_learning_rate_share;
    ensure("optimiser.final_learning_rate_share", share, (0.0..=1.0).contains(&share), "must be in [0, 1]")?;
    for (field, number) in [("optimiser.beta1", optimiser.beta1), ("optimiser.beta2", optimiser.beta2)] {
        ensure(field, number, (0.0..1.0).contains(&number), "must be in [0, 1)")?;
    }
    let norm = optimiser.max_gradient_norm;
    ensure("optimiser.max_gradient_norm", norm, not_negative(norm), "must be 0, which is off, or more")
}

fn unroll(unroll: &Unroll) -> Result<(), Fault> {
    ensure("unroll.length", unroll.length, (1..=LONGEST_UNROLL).contains(&unroll.length), "must be 1 to 4096")?;
    ensure("unroll.batch", unroll.batch, (1..=65536).contains(&unroll.batch), "must be 1 to 65536")?;
    let rows = unroll.batch * unroll.length;
    ensure("unroll.batch", unroll.batch, rows <= 1 << 20, "times unroll.length must be at most 1048576 rows")?;
    ensure("unroll.ahead", unroll.ahead, unroll.ahead <= 1, "must be 0 or 1")
}

fn actor(actor: &Actor) -> Result<(), Fault> {
    ensure("actor.threads", actor.threads, (1..=1024).contains(&actor.threads), "must be 1 to 1024")?;
    ensure("actor.environments", actor.environments, (1..=4096).contains(&actor.environments), "must be 1 to 4096")
}

/// Fields that make no sense beside one another.
fn together(experiment: &Experiment) -> Result<(), Fault> {
    let Experiment { unroll, budget, .. } = experiment;
    let holds = !unroll.lockstep || unroll.ahead == 0;
    ensure("unroll.ahead", unroll.ahead, holds, "must be 0 with unroll.lockstep")?;
    let holds = !unroll.lockstep || budget.minutes == 0.0;
    let remedy = "must be 0 with unroll.lockstep, which uses no clock; set budget.updates or budget.environment_steps";
    ensure("budget.minutes", budget.minutes, holds, remedy)
}

/// Fields that mean nothing to the experiment's algorithm, and faults of its own section.
fn algorithm(experiment: &Experiment) -> Result<(), Fault> {
    let unread = experiment.unread();
    // TOML can write every document whose numbers were checked.
    let changed = experiment.differences(&Experiment::default()).unwrap_or_default();
    if let Some(set) = changed.into_iter().find(|set| unread.iter().any(|name| is_within(&set.field, name))) {
        let remedy = format!("algorithm = \"{}\" does not read it; leave it at {}", experiment.algorithm, set.theirs);
        return Err(Fault { field: set.field, value: set.ours, remedy });
    }
    experiment.algorithm_parameters().check(&experiment.rest())
}

/// Whether `field` is `outer`, or a field of the section `outer`.
fn is_within(field: &str, outer: &str) -> bool {
    field.strip_prefix(outer).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

fn learner(learner: &Learner) -> Result<(), Fault> {
    let Learner { threads, checkpoint_seconds, checkpoints_kept, metrics_seconds, restore_after, .. } = learner;
    ensure("learner.threads", threads, (1..=1024).contains(threads), "must be 1 to 1024")?;
    ensure("learner.checkpoint_seconds", checkpoint_seconds, *checkpoint_seconds > 0.0, POSITIVE)?;
    ensure("learner.checkpoints_kept", checkpoints_kept, *checkpoints_kept > 0, AT_LEAST_ONE)?;
    ensure("learner.metrics_seconds", metrics_seconds, *metrics_seconds > 0.0, POSITIVE)?;
    ensure("learner.restore_after", restore_after, *restore_after > 0, AT_LEAST_ONE)
}

fn budget(budget: &Budget) -> Result<(), Fault> {
    ensure("budget.minutes", budget.minutes, not_negative(budget.minutes), "must be 0, which is no limit, or more")
}
