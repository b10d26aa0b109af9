//! Unrolls as tensors.

use std::ops::Index;

use comic_experiment::{Experiment, TaskSpec};
use comic_networks::Routing;
use comic_proto::{Field, PerField, UnrollShape};
use comic_replay::{Batch, Unrolls};
use tch::{Device, Tensor};

use crate::algorithm::error::Error;
use crate::algorithm::shape::MinibatchShape;
use crate::device::upload;

/// A minibatch of unrolls, batch first, one tensor for each field: float32, but int64 for [`Field::Clip`] and uint8 for
/// [`Field::Image`], which is undefined when the task has no camera. A field with one number in each row is `[B, rows]`,
/// [`Field::State`] is `[B, S]`, every other field `[B, rows, width]`.
///
/// The numbers of a row that holds no transition (its action, distribution, reward, latent) are blanked when the tensors
/// are made, so no formula can use them. Its observation stays, because a truncated episode is bootstrapped there.
#[derive(Debug)]
pub struct MinibatchTensors {
    fields: PerField<Tensor>,
    shape: MinibatchShape,
    /// One more than the largest clip index: known on the host, so no step has to ask the device.
    clips: usize,
    /// The task of each unroll, `[B]`, on the host, where it is decided which network each goes through.
    tasks: Vec<usize>,
    routing: Routing,
}

impl MinibatchTensors {
    /// Copies unrolls of these tasks, `[B]`, onto `device`.
    ///
    /// # Errors
    /// [`Error::Length`] when an array is not as long as `shape` says; [`Error::Task`] when there is no such task.
    pub fn new(unrolls: &Unrolls, tasks: &[usize], shape: &MinibatchShape, device: Device) -> Result<Self, Error> {
        check_length("tasks", tasks.len(), &[shape.unrolls])?;
        if let Some(task) = tasks.iter().copied().find(|task| *task >= shape.tasks) {
            return Err(Error::Task { task, tasks: shape.tasks });
        }
        let uploaded = |field: Field| {
            let size = size(field, shape);
            let elements = match field {
                Field::Clip => unrolls.clip().len(),
                Field::Image => unrolls.image().len(),
                _ => unrolls.f32(field).len(),
            };
            check_length(field.name(), elements, &size)?;
            let size: Vec<i64> = size.into_iter().map(|size| size as i64).collect();
            let tensor = match field {
                Field::Clip => {
                    let clips: Vec<i64> = unrolls.clip().iter().map(|clip| i64::from(*clip)).collect();
                    upload(&clips, &size, device)
                }
                Field::Image if shape.unroll.image == 0 => Ok(Tensor::new()),
                Field::Image => upload(unrolls.image(), &size, device),
                _ => upload(unrolls.f32(field), &size, device),
            };
            Ok::<Tensor, Error>(tensor?)
        };
        let valid = uploaded(Field::Valid)?;
        let mask = valid.gt(0.5).unsqueeze(-1);
        let mut fields = PerField::from_fn(|_| Tensor::new());
        for (field, tensor) in fields.iter_mut() {
            *tensor = match (field, field.blank(&shape.unroll)) {
                (Field::Valid, _) => valid.shallow_clone(),
                (Field::Discount, _) => uploaded(field)? * &valid,
                (_, Some(blank)) => uploaded(field)?.f_where_scalarother(&mask, blank)?,
                (_, None) => uploaded(field)?,
            };
        }
        Ok(Self {
            fields,
            shape: *shape,
            clips: unrolls.clip().iter().max().map_or(0, |clip| *clip as usize + 1),
            routing: Routing::blocked(tasks, shape.tasks, device),
            tasks: tasks.to_vec(),
        })
    }

    /// The sizes of this minibatch.
    pub fn shape(&self) -> MinibatchShape {
        self.shape
    }

    /// # Errors
    /// [`Error::Shape`] when the minibatch belongs to another experiment or task.
    pub(crate) fn check(&self, spec: &TaskSpec, experiment: &Experiment) -> Result<(), Error> {
        let found = self.shape;
        let unroll = UnrollShape { length: found.unroll.length, ..UnrollShape::new(spec, experiment) };
        let expected = MinibatchShape { unrolls: found.unrolls, tasks: spec.tasks.len(), unroll };
        let (clips, known) = (self.clips, spec.clips.len());
        if found == expected && clips <= known {
            return Ok(());
        }
        Err(Error::Shape { expected: Box::new(expected), found: Box::new(found), clips, known })
    }

    /// The task of each unroll, `[B]`.
    pub fn tasks(&self) -> &[usize] {
        &self.tasks
    }

    /// Which of the tasks' networks each unroll goes through.
    pub fn routing(&self) -> &Routing {
        &self.routing
    }

    /// One more than the largest clip index.
    pub fn clips(&self) -> usize {
        self.clips
    }

    /// The camera images, `[B, T+1, I]`, uint8; `None` when the task has no camera.
    pub fn image(&self) -> Option<&Tensor> {
        Some(&self.fields[Field::Image]).filter(|image| image.defined())
    }

    /// The unrolls at `unrolls`, each below B, copied.
    pub fn select(&self, unrolls: &[usize]) -> Self {
        let indices = self.indices(unrolls);
        let tasks: Vec<usize> = unrolls.iter().filter_map(|unroll| self.tasks.get(*unroll).copied()).collect();
        Self {
            routing: Routing::blocked(&tasks, self.shape.tasks, self.device()),
            tasks,
            shape: MinibatchShape { unrolls: unrolls.len(), ..self.shape },
            fields: self
                .fields
                .each_ref()
                .map(|_, tensor| if tensor.defined() { tensor.index_select(0, &indices) } else { Tensor::new() }),
            clips: self.clips,
        }
    }

    fn device(&self) -> Device {
        self.fields[Field::Valid].device()
    }

    fn indices(&self, unrolls: &[usize]) -> Tensor {
        let indices: Vec<i64> = unrolls.iter().map(|unroll| *unroll as i64).collect();
        Tensor::from_slice(&indices).to_device(self.device())
    }
}

/// A batch of unrolls of any of `tasks` tasks on the device.
///
/// # Errors
/// When the device refuses.
pub(crate) fn to_device(batch: &Batch, tasks: usize, device: Device) -> Result<MinibatchTensors, Error> {
    let shape = MinibatchShape { unrolls: batch.unrolls, tasks, unroll: *batch.layout.shape() };
    MinibatchTensors::new(batch.as_unrolls(), &batch.tasks(), &shape, device)
}

/// The tensor of a field.
impl Index<Field> for MinibatchTensors {
    type Output = Tensor;

    fn index(&self, field: Field) -> &Tensor {
        &self.fields[field]
    }
}

/// The size of a field's tensor.
fn size(field: Field, shape: &MinibatchShape) -> Vec<usize> {
    let (rows, width) = (field.rows(shape.unroll.length), field.width(&shape.unroll));
    match field {
        Field::Discount | Field::Valid | Field::First | Field::Clip => vec![shape.unrolls, rows],
        Field::State => vec![shape.unrolls, width],
        _ => vec![shape.unrolls, rows, width],
    }
}

fn check_length(field: &'static str, found: usize, size: &[usize]) -> Result<(), Error> {
    let expected = size.iter().product();
    if found == expected { Ok(()) } else { Err(Error::Length { field, expected, found }) }
}
