//! XLA by torch_xla, whose loader is written in Python: Python is started once, imports it, and is left alone. In training
//! only functions of its C++ are called, and no line of Python runs.

use std::ffi::CString;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow};
use comic_experiment::MatmulPrecision;
use pyo3::exceptions::PyMemoryError;
use pyo3::prelude::*;
use pyo3::types::PyList;
use tch::Device;

use crate::error::Error;

/// XLA in the terms of tch, which does not know it by name: see `xla.cpp`.
pub(super) const DEVICE: Device = Device::Mps;

/// Where `cargo xtask setup --xla` put torch and torch_xla when this was built.
const PACKAGES: &str = env!("COMIC_PYTHON_PACKAGES");
/// Overrides [`PACKAGES`], for a learner that is moved.
const PACKAGES_VARIABLE: &str = "COMIC_PYTHON_PACKAGES";
/// Seconds between two lines while something is compiled: on a TPU an update takes minutes.
const PATIENCE: Duration = Duration::from_secs(15);

/// Starts the plugin and leaves what training needs of it in a dictionary.
const START: &str = r"
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

fn lock(busy: &Busy) -> MutexGuard<'_, Option<Instant>> {
    busy.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A thread says so while something is compiled, as long as anybody holds what it looks at.
fn watched() -> Result<Arc<Busy>> {
    let busy = Arc::new(Busy::default());
    let seen = Arc::downgrade(&busy);
    std::thread::Builder::new().name("xla-watch".into()).spawn(move || {
        while let Some(busy) = seen.upgrade() {
            if let Some(seconds) = lock(&busy).map(|began| began.elapsed()).filter(|taken| *taken >= PATIENCE) {
                tracing::info!(seconds = seconds.as_secs(), "XLA is compiling");
            }
            drop(busy);
            std::thread::sleep(PATIENCE);
        }
    })?;
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
    /// Since when a step is being ended: that takes long where something is compiled.
    busy: Arc<Busy>,
}

impl Plugin {
    /// Starts Python and torch_xla. A process has one of either: what else is started is the same one.
    pub(super) fn start(index: usize, precision: MatmulPrecision) -> Result<Self> {
        let packages = std::env::var(PACKAGES_VARIABLE).unwrap_or_else(|_| PACKAGES.to_string());
        if !Path::new(&packages).join("torch_xla").is_dir() {
            return Err(Error::configuration(format!(
                "learner.device = \"xla:{index}\": there is no torch_xla in {packages}: `cargo xtask setup --xla`, or name its \
                 directory by {PACKAGES_VARIABLE}"
            ))
            .into());
        }
        let started = Instant::now();
        tracing::info!("starting torch_xla");
        Python::initialize();
        let plugin = Python::attach(|python| {
            let names = pyo3::types::PyDict::new(python);
            names.set_item("packages", &packages)?;
            names.set_item("precision", precision.name())?;
            names.set_item("index", index)?;
            python.run(&CString::new(START)?, Some(&names), None)?;
            let of = |name: &str| names.get_item(name)?.with_context(|| format!("torch_xla has no `{name}`"));
            if !of("found")?.extract::<bool>()? {
                let devices: Vec<String> = of("devices")?.extract()?;
                let problem: String = of("problem")?.extract()?;
                return Err(missing(index, &devices, &problem));
            }
            let kind: String = of("kind")?.extract()?;
            tracing::info!(device = index, kind, seconds = started.elapsed().as_secs(), "torch_xla is there");
            Ok(Self {
                device: of("device")?.extract()?,
                backward_in_threads: of("backward_in_threads")?.unbind(),
                step_marker: of("step_marker")?.unbind(),
                wait: of("wait")?.unbind(),
                metric_data: of("metric_data")?.unbind(),
                prepare_to_exit: of("prepare_to_exit")?.unbind(),
                busy: watched()?,
            })
        });
        plugin.map_err(|error: anyhow::Error| match error.downcast::<PyErr>() {
            Ok(error) => not_started(&packages, &error),
            Err(error) => error,
        })
    }

    /// The calling thread trains, as the one does that started the plugin: backward passes are its own from now on. libtorch's
    /// thread for them lets go of the gradients when its caller has gone on already, and what is still there when a step ends
    /// is one more result of the step's program, which would be compiled anew.
    pub(super) fn train_here(&self) -> Result<()> {
        Python::attach(|python| self.backward_in_threads.call1(python, (false,)).map(drop))
            .map_err(|error| anyhow!("XLA: {error}"))
    }

    /// Compiles what was recorded, if it is new, and hands it to the device.
    pub(super) fn end_step(&self) -> Result<()> {
        let (before, began) = (self.compilations()?, Instant::now());
        *lock(&self.busy) = Some(began);
        let marked = self.mark_step();
        *lock(&self.busy) = None;
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
        .map_err(|error| anyhow!("XLA: {error}"))
    }

    /// Waits until everything given was run.
    pub(super) fn wait(&self) -> Result<()> {
        Python::attach(|python| self.wait.call1(python, (PyList::empty(python),)).map(drop))
            .map_err(|error| anyhow!("XLA: {error}"))
    }

    /// Programs compiled so far.
    pub(super) fn compilations(&self) -> Result<u64> {
        Python::attach(|python| {
            let data = self.metric_data.call1(python, ("CompileTime",))?;
            // None before the first one; then how many, how long in all, and the last of them.
            let data: Option<(u64, f64, Py<PyAny>)> = data.extract(python)?;
            Ok(data.map_or(0, |(count, ..)| count))
        })
        .map_err(|error: PyErr| anyhow!("XLA: {error}"))
    }
}

/// What to say where torch_xla does not start. Whoever starts the learner again finds the same packages, unless it was the
/// system that refused memory or a file.
fn not_started(packages: &str, error: &PyErr) -> anyhow::Error {
    let said = format!(
        "cannot start torch_xla from {packages}: {error}; `cargo xtask setup --xla` fetches what it takes, and PJRT_DEVICE chooses \
         (TPU, CPU)"
    );
    let refused = Python::attach(|python| {
        let number = error.value(python).getattr("errno");
        error.is_instance_of::<PyMemoryError>(python) || number.is_ok_and(|number| !number.is_none())
    });
    if refused { anyhow!(said) } else { Error::configuration(said).into() }
}

/// What to say where there is no device of this number.
fn missing(index: usize, devices: &[String], problem: &str) -> anyhow::Error {
    let found = devices.join(", ");
    let said =
        format!("learner.device = \"xla:{index}\": PJRT has [{found}] {problem}; PJRT_DEVICE chooses (TPU, CPU)");
    // libtpu lets one process in: the learner before this one may still be on its way out. It says so in two ways.
    let busy = ["in use", "resource busy"].iter().any(|sign| problem.contains(sign));
    if busy { anyhow!(said) } else { Error::configuration(said).into() }
}

impl Drop for Plugin {
    /// Ends its threads while everything they use is still there. Python itself is not taken down.
    fn drop(&mut self) {
        if let Err(error) = Python::attach(|python| self.prepare_to_exit.call0(python).map(drop)) {
            tracing::warn!("torch_xla did not end well: {error}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_another_process_has_is_worth_another_start_and_none_at_all_is_not() {
        for busy in [
            "The TPU is already in use by process with pid 7. Not attempting to load libtpu.so in this process.",
            "TPU initialization failed: open(/dev/vfio/0): Device or resource busy; Couldn't open iommu group /dev/vfio/0",
        ] {
            assert_eq!(Error::from(missing(0, &[], busy)).exit_code(), 1, "{busy}");
        }
        assert_eq!(Error::from(missing(0, &[], "TPU initialization failed: no device found")).exit_code(), 2);
        assert_eq!(Error::from(missing(4, &["TPU:0".into()], "")).exit_code(), 2);
    }
}
