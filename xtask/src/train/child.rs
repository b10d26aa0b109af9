//! A child process that ends when its parent ends, however that ends.

use std::ffi::OsString;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, bail};
use rustix::process::{Pid, Signal, getpid, getppid, set_parent_process_death_signal};

/// `xtask child PARENT PROGRAM [ARGUMENT]…`
#[derive(clap::Args)]
pub(crate) struct Options {
    /// The process that must be the parent
    parent: i32,
    /// The program and its arguments
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, required = true)]
    command: Vec<OsString>,
}

/// A command for a program that gets SIGTERM when the thread that starts it ends, also when this process is killed. So start
/// it from a thread that outlives it. The command starts this program as [`run`], which becomes the other one.
pub(crate) fn command(program: &Path) -> Command {
    // This name works also while a newer build of this program has replaced the file.
    let mut command = Command::new("/proc/self/exe");
    command.arg("child").arg(getpid().as_raw_nonzero().to_string()).arg(program);
    command
}

/// Asks the kernel for a signal at the parent's end, and becomes the program.
pub(crate) fn run(options: &Options) -> Result<()> {
    set_parent_process_death_signal(Some(Signal::TERM)).context("cannot ask for a signal at the parent's end")?;
    // It may have ended before it was asked for.
    if getppid() != Pid::from_raw(options.parent) {
        bail!("the process {}, which started this one, has ended", options.parent);
    }
    let [program, arguments @ ..] = options.command.as_slice() else { bail!("there is no program to start") };
    let error = Command::new(program).args(arguments).exec();
    Err(error).with_context(|| format!("cannot start {}", Path::new(program).display()))
}
