//! Unrolls as tensors.

use comic_networks::Routing;
use comic_proto::UnrollShape;
use tch::{Device, Tensor};

use super::Error;
use crate::device::upload;

/// Sizes of a minibatch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MinibatchShape {
    /// B, unrolls.
    pub unrolls: usize,
    /// Tasks that they may be of.
    pub tasks: usize,
    /// The sizes of each.
    pub unroll: UnrollShape,
}

/// The fields of a batch as contiguous slices, `[B, rows, width]` each, in the wire's own element types.
#[derive(Clone, Copy, Debug)]
pub struct MinibatchSource<'a> {
    /// s, `[B, T+1, P]`.
    pub proprioception: &'a [f32],
    /// x, `[B, T+1, X]`.
    pub task: &'a [f32],
    /// The sampled z_{t−1}, `[B, T, Z]`; zeros at an episode's start.
    pub previous_latent: &'a [f32],
    /// The standard-normal noise that made z_t, `[B, T, Z]`.
    pub latent_noise: &'a [f32],
    /// The sampled action, unclipped, `[B, T, A]`.
    pub action: &'a [f32],
    /// The behaviour policy's means, `[B, T, K·A]`.
    pub mean: &'a [f32],
    /// The behaviour policy's standard deviations, `[B, T, K·A]`.
    pub std: &'a [f32],
    /// ln of the behaviour policy's weights, `[B, T, K]`; empty where K is 1.
    pub log_weights: &'a [f32],
    /// Reward terms, `[B, T, R]`.
    pub reward: &'a [f32],
    /// 0 where the episode terminated, `[B, T]`.
    pub discount: &'a [f32],
    /// 1 where the row is a transition, `[B, T]`.
    pub valid: &'a [f32],
    /// 1 at an episode's first observation, `[B, T+1]`.
    pub first: &'a [f32],
    /// What the policy remembered at the first row, `[B, S]`.
    pub state: &'a [f32],
    /// The clip's index, `[B, T+1]`.
    pub clip: &'a [u32],
    /// What the humanoid sees, `[B, T+1, I]`; empty when the task is blind.
    pub image: &'a [u8],
    /// The task of each unroll, `[B]`.
    pub tasks: &'a [usize],
}

/// A minibatch of unrolls, batch first, float32 except `clip` and `image`.
///
/// What belongs to a row that is no transition (its action, distribution, reward, latent) is blanked when the tensors
/// are made, so no formula can see it; its observation stays, since a truncated episode is bootstrapped there.
#[derive(Debug)]
pub struct MinibatchTensors {
    pub(super) proprioception: Tensor,
    pub(super) task: Tensor,
    pub(super) previous_latent: Tensor,
    pub(super) latent_noise: Tensor,
    pub(super) action: Tensor,
    pub(super) mean: Tensor,
    pub(super) std: Tensor,
    pub(super) log_weights: Tensor,
    pub(super) reward: Tensor,
    pub(super) discount: Tensor,
    pub(super) valid: Tensor,
    pub(super) first: Tensor,
    pub(super) state: Tensor,
    pub(super) clip: Tensor,
    /// uint8; none when the task is blind.
    pub(super) image: Option<Tensor>,
    /// One more than the largest clip index: known on the host, so no step has to ask the device.
    pub(super) clips: usize,
    /// The task of each unroll, `[B]`, on the host, where it is decided which network each goes through.
    tasks: Vec<usize>,
    task_count: usize,
    pub(super) routing: Routing,
}

impl MinibatchTensors {
    /// Copies the fields onto `device`.
    ///
    /// # Errors
    /// [`Error::Length`] when a slice is not as long as `shape` says.
    pub fn new(source: &MinibatchSource, shape: &MinibatchShape, device: Device) -> Result<Self, Error> {
        let MinibatchShape { unrolls, tasks: task_count, unroll } = *shape;
        let (steps, observations) = (unroll.length, unroll.length + 1);
        let tensor = |name, values: &[f32], rows: usize, width: usize| {
            let size = [unrolls, rows, width];
            check(name, values.len(), &size)?;
            Ok::<Tensor, Error>(upload(values, &size.map(|size| size as i64), device)?)
        };
        let flag = |name, values, rows| Ok::<Tensor, Error>(tensor(name, values, rows, 1)?.f_squeeze_dim(-1)?);
        let valid = flag("valid", source.valid, steps)?;
        let mask = valid.gt(0.5).unsqueeze(-1);
        let blanked = |name, values, width, blank: f64| {
            Ok::<Tensor, Error>(tensor(name, values, steps, width)?.f_where_scalarother(&mask, blank)?)
        };
        check("clip", source.clip.len(), &[unrolls, observations])?;
        check("tasks", source.tasks.len(), &[unrolls])?;
        if let Some(task) = source.tasks.iter().copied().find(|task| *task >= task_count) {
            return Err(Error::Task { task, tasks: task_count });
        }
        let size = [unrolls, observations, unroll.image];
        check("image", source.image.len(), &size)?;
        let image =
            if unroll.image == 0 { None } else { Some(upload(source.image, &size.map(|size| size as i64), device)?) };
        let components = unroll.components;
        let (weights, even) = (if components > 1 { components } else { 0 }, -(components as f64).ln());
        let clip: Vec<i64> = source.clip.iter().map(|clip| i64::from(*clip)).collect();
        Ok(Self {
            proprioception: tensor("proprioception", source.proprioception, observations, unroll.proprioception)?,
            task: tensor("task", source.task, observations, unroll.task)?,
            previous_latent: blanked("previous_latent", source.previous_latent, unroll.latent, 0.0)?,
            latent_noise: blanked("latent_noise", source.latent_noise, unroll.latent, 0.0)?,
            action: blanked("action", source.action, unroll.action, 0.0)?,
            mean: blanked("mean", source.mean, components * unroll.action, 0.0)?,
            std: blanked("std", source.std, components * unroll.action, 1.0)?,
            log_weights: blanked("log_weights", source.log_weights, weights, even)?,
            reward: blanked("reward", source.reward, unroll.reward_terms, 0.0)?,
            discount: flag("discount", source.discount, steps)? * &valid,
            first: flag("first", source.first, observations)?,
            state: tensor("state", source.state, 1, unroll.state)?.f_squeeze_dim(1)?,
            clip: upload(&clip, &[unrolls as i64, observations as i64], device)?,
            image,
            clips: source.clip.iter().max().map_or(0, |clip| *clip as usize + 1),
            routing: Routing::blocked(source.tasks, task_count, device),
            tasks: source.tasks.to_vec(),
            task_count,
            valid,
        })
    }

    /// The sizes of this minibatch.
    pub fn shape(&self) -> MinibatchShape {
        let width = |tensor: &Tensor, dimension: i64| tensor.size()[dimension as usize] as usize;
        MinibatchShape {
            unrolls: width(&self.valid, 0),
            tasks: self.task_count,
            unroll: UnrollShape {
                length: width(&self.valid, 1),
                proprioception: width(&self.proprioception, 2),
                task: width(&self.task, 2),
                action: width(&self.action, 2),
                latent: width(&self.latent_noise, 2),
                reward_terms: width(&self.reward, 2),
                image: self.image.as_ref().map_or(0, |image| width(image, 2)),
                components: width(&self.log_weights, 2).max(1),
                state: width(&self.state, 1),
            },
        }
    }

    /// The task of each unroll, `[B]`.
    pub fn tasks(&self) -> &[usize] {
        &self.tasks
    }

    /// z_{t−1} as the next step will take it, `[B, T, Z]`.
    pub fn previous_latent(&self) -> &Tensor {
        &self.previous_latent
    }

    /// The unrolls at `unrolls`, each below B, copied.
    pub fn select(&self, unrolls: &[usize]) -> Self {
        let indices = self.indices(unrolls);
        let take = |tensor: &Tensor| tensor.index_select(0, &indices);
        let tasks: Vec<usize> = unrolls.iter().filter_map(|unroll| self.tasks.get(*unroll).copied()).collect();
        Self {
            routing: Routing::blocked(&tasks, self.task_count, self.valid.device()),
            tasks,
            task_count: self.task_count,
            proprioception: take(&self.proprioception),
            task: take(&self.task),
            previous_latent: take(&self.previous_latent),
            latent_noise: take(&self.latent_noise),
            action: take(&self.action),
            mean: take(&self.mean),
            std: take(&self.std),
            log_weights: take(&self.log_weights),
            reward: take(&self.reward),
            discount: take(&self.discount),
            valid: take(&self.valid),
            first: take(&self.first),
            state: take(&self.state),
            clip: take(&self.clip),
            image: self.image.as_ref().map(take),
            clips: self.clips,
        }
    }

    fn indices(&self, unrolls: &[usize]) -> Tensor {
        let indices: Vec<i64> = unrolls.iter().map(|unroll| *unroll as i64).collect();
        Tensor::from_slice(&indices).to_device(self.valid.device())
    }

    /// Replaces z_{t−1} of M unrolls by `latents`, z_t as recomputed for them, `[M, T, Z]`: row t takes z_{t−1}, an
    /// episode's first row zeros, and row 0 keeps what it has, since the step before it is not here.
    pub fn refresh_previous_latent(&mut self, unrolls: &[usize], latents: &Tensor) {
        let indices = &self.indices(unrolls);
        tch::no_grad(|| {
            let steps = latents.size()[1] - 1;
            let stored = self.previous_latent.index_select(0, indices);
            let within = 1.0 - self.first.index_select(0, indices).narrow(1, 1, steps);
            let valid = self.valid.index_select(0, indices).narrow(1, 1, steps);
            let kept: Tensor = within * valid;
            let moved = latents.narrow(1, 0, steps) * kept.unsqueeze(-1);
            let refreshed = Tensor::cat(&[stored.narrow(1, 0, 1), moved], 1);
            let _ = self.previous_latent.index_copy_(0, indices, &refreshed);
        });
    }
}

fn check(field: &'static str, found: usize, size: &[usize]) -> Result<(), Error> {
    let expected = size.iter().product();
    if found == expected { Ok(()) } else { Err(Error::Length { field, expected, found }) }
}
