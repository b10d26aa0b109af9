//! What a serving process needs of the operating system: threads and file descriptors.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::runtime::Runtime;

use crate::error::{Error, Result};

/// The threads that serve: one for each processor, at most four.
///
/// # Errors
/// [`Error::System`] when the system gives no threads.
pub fn runtime() -> Result<Runtime> {
    let workers = std::thread::available_parallelism().map_or(2, usize::from).clamp(1, 4);
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(workers)
        .enable_all()
        .build()
        .map_err(Error::system("cannot start tokio"))
}

/// Raises the limit of file descriptors to `wanted`, as far as the system allows. Each connection takes one, and systems
/// often allow 1024 at first.
pub fn allow_descriptors(wanted: u64) {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    if current.is_none_or(|current| current >= wanted) {
        return;
    }
    let allowed = maximum.map_or(wanted, |maximum| maximum.min(wanted));
    let raised = setrlimit(Resource::Nofile, Rlimit { current: Some(allowed), maximum });
    if raised.is_err() || allowed < wanted {
        tracing::warn!(wanted, ?current, ?maximum, "too few file descriptors for --max-actors: raise `ulimit -n`");
    }
}
