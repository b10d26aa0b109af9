//! XLA through torch_xla, whose loader is written in Python. Python is started once to import it. Training calls only its
//! C++ functions and runs no Python code.

use std::ffi::CStr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use comic_experiment::MatmulPrecision;
use parking_lot::Mutex;
use pyo3::exceptions::{PyKeyError, PyMemoryError};
use pyo3::prelude::*;
use pyo3::types::PyList;
use tch::Device;

use crate::error::{Error, Result};

/// The device by which tch, which has no name for XLA, reaches it: see `xla.cpp`.
pub(super) const DEVICE: Device = Device::Mps;

/// Where `cargo xtask setup --xla` put torch and torch_xla when this was built.
const PACKAGES: &str = env!("COMIC_PYTHON_PACKAGES");
/// Overrides [`PACKAGES`], for a learner that was moved to another place.
const PACKAGES_VARIABLE: &str = "COMIC_PYTHON_PACKAGES";
/// Time between two log lines during a compilation: on a TPU that of an update takes minutes.
const PATIENCE: Duration = Duration::from_secs(15);

/// Starts the plugin and puts the functions that training needs into a dictionary.
const START: &CStr = cr"
import os, sys
sys.path.insert(0, packages)
import torch
import torch_xla
from torch_xla import runtime
if precision != 'default':
    torch_xla._XLAC._xla_set_mat_mul_precision(precision)
try:
    devices, problem = torch_xla._XLAC._xla_get_devices(), ''
except RuntimeError as error:
    devices, problem = [], (str(error).splitlines() or [''])[0]
device = f'xla:{index}'
found = index < len(devices)
if found:
    # Of this thread, and for the factories of xla.cpp.
    torch_xla._XLAC._xla_set_default_device(device)
os.environ['COMIC_XLA_INDEX'] = str(index)
kind = runtime.device_type() if found else ''
backward_in_threads = torch._C._set_multithreading_enabled
backward_in_threads(False)
step_marker = torch_xla._XLAC._xla_step_marker
wait = torch_xla._XLAC._xla_wait_device_ops
metric_data = torch_xla._XLAC._xla_metric_data
prepare_to_exit = torch_xla._XLAC._prepare_to_exit
";

type Busy = Mutex<Option<Instant>>;

/// Starts a thread that logs long compilations. It ends when the returned value is dropped.
fn watched() -> Result<Arc<Busy>> {
    let busy = Arc::new(Busy::default());
    let seen = Arc::downgrade(&busy);
    let watch = move || {
        while let Some(busy) = seen.upgrade() {
            if let Some(seconds) = busy.lock().map(|began| began.elapsed()).filter(|taken| *taken >= PATIENCE) {
                tracing::info!(seconds = seconds.as_secs(), "XLA is compiling");
            }
            drop(busy);
            std::thread::sleep(PATIENCE);
        }
    };
    let thread = std::thread::Builder::new().name("xla-watch".into()).spawn(watch);
    thread.map_err(Error::system("cannot start the thread that watches XLA"))?;
    Ok(busy)
}

/// torch_xla, started.
#[derive(Debug)]
pub(super) struct Plugin {
    device: String,
    backward_in_threads: Py<PyAny>,
    step_marker: Py<PyAny>,
    wait: Py<PyAny>,
    metric_data: Py<PyAny>,
    prepare_to_exit: Py<PyAny>,
    /// When the end of the current step began. It takes long if something is compiled.
    busy: Arc<Busy>,
}

impl Plugin {
    /// Starts Python and torch_xla. A process has only one of each, so another start gives the same.
    pub(super) fn start(index: usize, precision: MatmulPrecision) -> Result<Self> {
        let packages = std::env::var(PACKAGES_VARIABLE).unwrap_or_else(|_| PACKAGES.to_string());
        if !Path::new(&packages).join("torch_xla").is_dir() {
            return Err(Error::configuration(format!(
                "learner.device = \"xla:{index}\": there is no torch_xla in {packages}: run `cargo xtask setup --xla`, or name \
                 its directory by {PACKAGES_VARIABLE}"
            )));
        }
        let started = Instant::now();
        tracing::info!("starting torch_xla");
        Python::initialize();
        let busy = watched()?;
        let plugin = Python::attach(|python| -> PyResult<Result<Self>> {
            let names = pyo3::types::PyDict::new(python);
            names.set_item("packages", &packages)?;
            names.set_item("precision", precision.name())?;
            names.set_item("index", index)?;
            python.run(START, Some(&names), None)?;
            let of = |name: &'static str| names.get_item(name)?.ok_or_else(|| PyKeyError::new_err(name));
            if !of("found")?.extract::<bool>()? {
                let devices: Vec<String> = of("devices")?.extract()?;
                let problem: String = of("problem")?.extract()?;
                return Ok(Err(missing(index, &devices, &problem)));
            }
            let kind: String = of("kind")?.extract()?;
            tracing::info!(device = index, kind, seconds = started.elapsed().as_secs(), "torch_xla is ready");
            Ok(Ok(Self {
                device: of("device")?.extract()?,
                backward_in_threads: of("backward_in_threads")?.unbind(),
                step_marker: of("step_marker")?.unbind(),
                wait: of("wait")?.unbind(),
                metric_data: of("metric_data")?.unbind(),
                prepare_to_exit: of("prepare_to_exit")?.unbind(),
                busy,
            }))
        });
        plugin.map_err(|error| not_started(&packages, &error))?
    }

    /// Makes the calling thread run its backward passes itself, as the thread does that started the plugin. libtorch's own
    /// thread for them would free the gradients after its caller has continued. A gradient that exists when a step ends is
    /// one more result of the step's program, which would then be compiled again.
    pub(super) fn train_here(&self) -> Result<()> {
        Python::attach(|python| self.backward_in_threads.call1(python, (false,)).map(drop)).map_err(failed)
    }

    /// Compiles the recorded operations, if they are new, and gives them to the device.
    pub(super) fn end_step(&self) -> Result<()> {
        let (before, began) = (self.compilations()?, Instant::now());
        *self.busy.lock() = Some(began);
        let marked = self.mark_step();
        *self.busy.lock() = None;
        marked?;
        let programs = self.compilations()?.saturating_sub(before);
        if programs > 0 {
            tracing::info!(programs, seconds = began.elapsed().as_secs_f64(), "XLA compiled");
        }
        Ok(())
    }

    fn mark_step(&self) -> Result<()> {
        Python::attach(|python| {
            let every_tensor = PyList::empty(python);
            self.step_marker.call1(python, (&self.device, every_tensor, false, true)).map(drop)
        })
        .map_err(failed)
    }

    /// Waits until everything was run.
    pub(super) fn wait(&self) -> Result<()> {
        Python::attach(|python| self.wait.call1(python, (PyList::empty(python),)).map(drop)).map_err(failed)
    }

    /// Programs compiled so far.
    pub(super) fn compilations(&self) -> Result<u64> {
        Python::attach(|python| {
            let data = self.metric_data.call1(python, ("CompileTime",))?;
            // None before the first compilation; then the count, the total time, and the last times.
            let data: Option<(u64, f64, Py<PyAny>)> = data.extract(python)?;
            Ok(data.map_or(0, |(count, ..)| count))
        })
        .map_err(failed)
    }
}

/// The error of a call that failed.
fn failed(error: PyErr) -> Error {
    Error::Device(format!("XLA: {error}"))
}

/// The error when torch_xla does not start. Another start finds the same packages, so the configuration is wrong, unless the
/// system refused memory or a file.
fn not_started(packages: &str, error: &PyErr) -> Error {
    let said = format!(
        "cannot start torch_xla from {packages}: {error}; `cargo xtask setup --xla` fetches what it needs, and PJRT_DEVICE \
         chooses the device (TPU, CPU)"
    );
    let refused = Python::attach(|python| {
        let number = error.value(python).getattr("errno");
        error.is_instance_of::<PyMemoryError>(python) || number.is_ok_and(|number| !number.is_none())
    });
    if refused { Error::Device(said) } else { Error::Configuration(said) }
}

/// The error when there is no device of this number.
fn missing(index: usize, devices: &[String], problem: &str) -> Error {
    let found = devices.join(", ");
    let said = format!(
        "learner.device = \"xla:{index}\": PJRT has [{found}] {problem}; PJRT_DEVICE chooses the device (TPU, CPU)"
    );
    // libtpu serves one process at a time, and the learner before this one may still be ending. It has two messages for that.
    let busy = ["in use", "resource busy"].iter().any(|sign| problem.contains(sign));
    if busy { Error::Device(said) } else { Error::Configuration(said) }
}

impl Drop for Plugin {
    /// Ends the plugin's threads while everything they use still exists. Python itself is not stopped.
    fn drop(&mut self) {
        if let Err(error) = Python::attach(|python| self.prepare_to_exit.call0(python).map(drop)) {
            tracing::warn!("torch_xla could not be stopped: {error}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_another_process_uses_is_worth_another_start_and_a_missing_one_is_not() {
        for busy in [
            "The TPU is already in use by process with pid 7. Not attempting to load libtpu.so in this process.",
            "TPU initialization failed: open(/dev/vfio/0): Device or resource busy; Couldn't open iommu group /dev/vfio/0",
        ] {
            assert_eq!(missing(0, &[], busy).exit_code(), 1, "{busy}");
        }
        assert_eq!(missing(0, &[], "TPU initialization failed: no device found").exit_code(), 2);
        assert_eq!(missing(4, &["TPU:0".into()], "").exit_code(), 2);
    }
}
