//! Where the learner computes: the one place that knows what devices there are.
//!
//! The update is written once, in [`vmpo`](crate::vmpo), for whatever [`Backend::device`] is. What differs is here: how a
//! device is found, how a batch gets there, and that XLA is told where a gradient step ends.

#[cfg(cuda)]
mod cuda;
#[cfg(feature = "xla")]
mod xla;

use anyhow::Result;
use comic_experiment::{DeviceName, Learner};
use tch::kind::Element;
use tch::{Device, TchError, Tensor};

use crate::error::Error;

/// A device that is there.
#[derive(Debug)]
pub struct Backend {
    name: DeviceName,
    device: Device,
    #[cfg(feature = "xla")]
    xla: Option<xla::Plugin>,
}

impl Backend {
    /// The device the experiment names, ready for tensors.
    ///
    /// # Errors
    /// [`Error::Configuration`] with the remedy when the device was not built in or is not there.
    pub fn open(learner: &Learner) -> Result<Self> {
        match learner.device {
            DeviceName::Cpu => Ok(Self::cpu()),
            DeviceName::Cuda(index) => Self::cuda(index),
            DeviceName::Xla(index) => Self::xla(index, learner),
        }
    }

    /// This machine's processors.
    pub fn cpu() -> Self {
        Self::of(DeviceName::Cpu, Device::Cpu)
    }

    fn of(name: DeviceName, device: Device) -> Self {
        Self {
            name,
            device,
            #[cfg(feature = "xla")]
            xla: None,
        }
    }

    fn cuda(index: usize) -> Result<Self> {
        let count = usize::try_from(tch::Cuda::device_count()).unwrap_or(0);
        if index < count {
            return Ok(Self::of(DeviceName::Cuda(index), Device::Cuda(index)));
        }
        let found = if count == 0 { "no card" } else { "other cards only" };
        Err(Error::configuration(format!(
            "learner.device = \"cuda:{index}\": libtorch finds {found} ({count}). It takes an NVIDIA driver that lists the \
             card (nvidia-smi), and a learner built with CUDA: `cargo xtask setup --cuda`, then build again"
        ))
        .into())
    }

    #[cfg(feature = "xla")]
    fn xla(index: usize, learner: &Learner) -> Result<Self> {
        let plugin = xla::Plugin::start(index, learner.matmul_precision)?;
        Ok(Self { xla: Some(plugin), ..Self::of(DeviceName::Xla(index), xla::DEVICE) })
    }

    #[cfg(not(feature = "xla"))]
    fn xla(index: usize, _learner: &Learner) -> Result<Self> {
        Err(Error::configuration(format!(
            "learner.device = \"xla:{index}\": this learner was built without XLA: `cargo xtask setup --xla`, then \
             `cargo build --release --package comic-learner --features xla`"
        ))
        .into())
    }

    /// As the experiment writes it.
    pub fn name(&self) -> DeviceName {
        self.name
    }

    /// As libtorch's bindings write it.
    pub fn device(&self) -> Device {
        self.device
    }

    /// Whether it works on while its caller does something else, so that asking for a result means to wait.
    pub fn is_asynchronous(&self) -> bool {
        self.device != Device::Cpu
    }

    /// Tells the device that the calling thread, if it is not the one that opened it, is the one that trains.
    ///
    /// # Errors
    /// When XLA refuses.
    pub fn train_here(&self) -> Result<()> {
        #[cfg(feature = "xla")]
        if let Some(xla) = &self.xla {
            return xla.train_here();
        }
        Ok(())
    }

    /// Ends a gradient step. XLA compiles what was recorded since the last end, if it is new, and runs it; elsewhere
    /// everything runs as it is written, and there is nothing to end. Does not wait for results.
    ///
    /// # Errors
    /// When XLA cannot compile or run it.
    pub fn end_step(&self) -> Result<()> {
        #[cfg(feature = "xla")]
        if let Some(xla) = &self.xla {
            return xla.end_step();
        }
        Ok(())
    }

    /// Waits until the device has done what it was given.
    ///
    /// # Errors
    /// When XLA cannot run it.
    pub fn wait(&self) -> Result<()> {
        if let DeviceName::Cuda(index) = self.name {
            tch::Cuda::synchronize(index as i64);
        }
        #[cfg(feature = "xla")]
        if let Some(xla) = &self.xla {
            return xla.wait();
        }
        Ok(())
    }

    /// Programs compiled so far; 0 where nothing is compiled.
    ///
    /// # Errors
    /// When XLA does not say.
    pub fn compilations(&self) -> Result<u64> {
        #[cfg(feature = "xla")]
        if let Some(xla) = &self.xla {
            return xla.compilations();
        }
        Ok(0)
    }
}

/// Values of a batch as a tensor of this size, one copy of them all. On a card it comes while earlier updates are still
/// computed: from pinned memory, on a stream of its own.
///
/// # Errors
/// When there are not as many values as `size` says, or the device refuses.
pub(crate) fn upload<T: Element>(values: &[T], size: &[i64], device: Device) -> Result<Tensor, TchError> {
    #[cfg(cuda)]
    if let Device::Cuda(card) = device {
        return cuda::upload(values, size, card);
    }
    Tensor::from_slice(values).f_reshape(size)?.f_to_device(device)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(device: DeviceName) -> Error {
        Backend::open(&Learner { device, ..Learner::default() }).unwrap_err().into()
    }

    #[test]
    fn a_card_that_is_not_there_is_refused_with_its_remedy() {
        let error = open(DeviceName::Cuda(255));
        assert!(error.exit_code() == 2 && error.to_string().contains("setup --cuda"), "{error}");
    }

    #[cfg(not(feature = "xla"))]
    #[test]
    fn a_learner_without_xla_says_how_it_gets_one() {
        let error = open(DeviceName::Xla(0));
        assert!(error.exit_code() == 2 && error.to_string().contains("--features xla"), "{error}");
    }
}
