//! The learner's devices; no other module knows which kinds exist.
//!
//! The update is written once, for any device. The differences are here: how a device is found, how a batch is copied to it,
//! and that XLA is told where a gradient step ends.

#[cfg(cuda)]
mod cuda;
#[cfg(feature = "xla")]
mod xla;

use comic_experiment::{DeviceName, Learner};
use tch::kind::Element;
use tch::{Device, TchError, Tensor};

use crate::error::{Error, Result};

/// A device that was found.
#[derive(Debug)]
pub struct Backend {
    name: DeviceName,
    device: Device,
    #[cfg(feature = "xla")]
    xla: Option<xla::Plugin>,
}

impl Backend {
    /// Opens the device that the experiment names.
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

    /// The processors of this machine.
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
        let found = if count == 0 { "no GPU" } else { "other GPUs only" };
        Err(Error::configuration(format!(
            "learner.device = \"cuda:{index}\": libtorch finds {found} ({count}). This needs an NVIDIA driver that lists the \
             GPU (nvidia-smi), and a learner built with CUDA: `cargo xtask setup --cuda`, then build again"
        )))
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
        )))
    }

    /// The device's name in the experiment.
    pub fn name(&self) -> DeviceName {
        self.name
    }

    /// The device for libtorch's bindings.
    pub fn device(&self) -> Device {
        self.device
    }

    /// Whether it computes while its caller continues, so that reading a result means to wait.
    pub fn is_asynchronous(&self) -> bool {
        self.device != Device::Cpu
    }

    /// Tells the device that the calling thread trains. It may be another thread than the one that opened the device.
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

    /// Ends a gradient step. XLA compiles the operations since the last end, if they are new, and runs them. On other
    /// devices this does nothing, because every operation runs at once. Does not wait for results.
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

    /// Waits until the device has finished its work.
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

    /// Programs compiled so far; 0 on devices that do not compile.
    ///
    /// # Errors
    /// When XLA cannot tell.
    pub fn compilations(&self) -> Result<u64> {
        #[cfg(feature = "xla")]
        if let Some(xla) = &self.xla {
            return xla.compilations();
        }
        Ok(0)
    }
}

/// Copies values of a batch once, to a tensor of this size. The copy to a GPU runs during earlier updates: from pinned
/// memory, on a separate stream.
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
        Backend::open(&Learner { device, ..Learner::default() }).unwrap_err()
    }

    #[test]
    fn a_missing_gpu_is_refused_with_its_remedy() {
        let error = open(DeviceName::Cuda(255));
        assert!(error.exit_code() == 2 && error.to_string().contains("setup --cuda"), "{error}");
    }

    #[cfg(not(feature = "xla"))]
    #[test]
    fn a_learner_without_xla_says_how_to_build_one_with_it() {
        let error = open(DeviceName::Xla(0));
        assert!(error.exit_code() == 2 && error.to_string().contains("--features xla"), "{error}");
    }
}
