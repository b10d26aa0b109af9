//! Neighbours that compute all the time.

use std::process::{Child, Command, Stdio};

use anyhow::{Context as _, Result};

/// Busy processes of equal priority, until this is dropped.
#[derive(Debug)]
pub(crate) struct Busy(Vec<Child>);

impl Busy {
    /// Starts `count` of them.
    ///
    /// # Errors
    /// When there is no shell.
    pub(crate) fn start(count: usize) -> Result<Self> {
        let mut busy = Self(Vec::new());
        for _ in 0..count {
            let mut shell = Command::new("sh");
            // They end with this process, however that ends.
            let child = shell
                .args(["-c", "while kill -0 $PPID; do :; done"])
                .stdin(Stdio::null())
                .stderr(Stdio::null())
                .spawn();
            busy.0.push(child.context("cannot start a busy process")?);
        }
        Ok(busy)
    }
}

/// One for each core that this process may use.
///
/// # Errors
/// When the system does not say.
pub(crate) fn cores() -> Result<usize> {
    Ok(std::thread::available_parallelism().context("the number of cores is not known")?.get())
}

impl Drop for Busy {
    fn drop(&mut self) {
        for child in &mut self.0 {
            // An error means that it has ended already.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}
