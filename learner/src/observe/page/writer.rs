//! Writes pages in a thread of its own, so that training does not wait for the disk.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use crate::checkpoint::replace_file;

/// The writing thread. At most one page waits. The drop waits until everything is on disk.
#[derive(Debug)]
pub(super) struct PageWriter {
    /// `None` without a thread, and at the end.
    queue: Option<SyncSender<Vec<u8>>>,
    thread: Option<JoinHandle<()>>,
}

impl PageWriter {
    /// Starts the thread, which writes to `path`. If the system gives no thread, that is logged, and there is no page.
    pub(super) fn start(path: PathBuf) -> Self {
        let (queue, received) = sync_channel(1);
        let thread = std::thread::Builder::new().name("page".into()).spawn(move || write_all(&path, &received));
        match thread {
            Ok(thread) => Self { queue: Some(queue), thread: Some(thread) },
            Err(error) => {
                tracing::error!("there is no page of the run, because its thread cannot be started: {error}");
                Self { queue: None, thread: None }
            }
        }
    }

    /// Has a page written, and says whether it will be. While another one waits, this one is left out: the next one has everything
    /// that it has.
    pub(super) fn write(&self, page: Vec<u8>) -> bool {
        self.queue.as_ref().is_some_and(|queue| queue.try_send(page).is_ok())
    }

    /// Has the last page written; waits while another one waits.
    pub(super) fn write_last(&self, page: Vec<u8>) {
        if let Some(queue) = &self.queue {
            let _ = queue.send(page);
        }
    }
}

impl Drop for PageWriter {
    fn drop(&mut self) {
        self.queue = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Writes pages until the queue is closed.
fn write_all(path: &Path, pages: &Receiver<Vec<u8>>) {
    while let Ok(page) = pages.recv() {
        if let Err(error) = replace_file(path, page) {
            tracing::error!("the page of the run is not written: {}", comic_proto::chain(&error));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn while_a_page_waits_others_are_left_out_but_the_last_one_is_not() {
        let (queue, pages) = sync_channel(1);
        let writer = PageWriter { queue: Some(queue), thread: None };
        assert!(writer.write(b"first".into()));
        assert!(!writer.write(b"second".into()));
        // The writer ends there, and with it the queue.
        let last = std::thread::spawn(move || writer.write_last(b"last".into()));
        let written: Vec<Vec<u8>> = pages.iter().collect();
        last.join().unwrap();
        assert_eq!(written, [b"first".to_vec(), b"last".to_vec()]);
    }
}
