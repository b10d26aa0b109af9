//! What tells a run from every other.

use std::fs;
use std::io::ErrorKind;

use anyhow::{Context as _, Result};

use super::Store;
use super::steps::{carry_out, replace};
use crate::error::Error;

const RUN: &str = "run";

impl Store {
    /// A number that was drawn when the run began. Epochs and versions begin anew with every run: actors that come back to the
    /// same address are told by it that theirs is over.
    ///
    /// # Errors
    /// [`Error::Configuration`] when its file is damaged; otherwise when it cannot be read or written.
    pub fn run(&self) -> Result<u64> {
        let path = self.directory.join(RUN);
        match fs::read(&path) {
            Ok(bytes) => u64::from_str_radix(String::from_utf8_lossy(&bytes).trim(), 16).map_err(|_| {
                let remedy = "remove it, and start the actors again";
                Error::configuration(format!("{} is damaged: {remedy}", path.display())).into()
            }),
            Err(error) if error.kind() == ErrorKind::NotFound => {
                let run = rand::random();
                carry_out(&replace(&path, format!("{run:016x}").into_bytes()))?;
                Ok(run)
            }
            Err(error) => Err(error).with_context(|| format!("cannot read {}", path.display())),
        }
    }
}
