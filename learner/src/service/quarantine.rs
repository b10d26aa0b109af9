//! Keeps invalid unrolls on disk, so that an operator can find out what is wrong with them.
//!
//! Each unroll is one file `EPOCH-ACTOR-SEQUENCE.unroll`: eight bytes, little-endian, with the length of a JSON object; the
//! object, which holds the header and the reason; and the payload as it was received.

use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use clap::Args;
use comic_proto::v1::UnrollHeader;
use comic_proto::{Invalid, Pieces, chain};
use serde_json::json;

use crate::error::{Error, Result};
use crate::log_limiter::LogLimiter;
use crate::observe::prometheus::Prometheus;

/// Unrolls that may wait for the disk; others are discarded.
const QUEUE: usize = 8;
/// Bytes of a layout hash that are kept; the peer may send any number.
const HASH: usize = 32;

/// Where invalid unrolls go.
#[derive(Clone, Debug, Default, Args)]
pub struct QuarantineArguments {
    /// Directory that keeps the unrolls refused as invalid, for inspection [default: they are not kept].
    #[arg(long, value_name = "DIR", help_heading = "Quarantine")]
    pub quarantine: Option<PathBuf>,
    /// Bytes that these unrolls may take in all, including those of earlier starts.
    #[arg(long, value_name = "BYTES", default_value_t = 64 << 20, requires = "quarantine", help_heading = "Quarantine")]
    pub quarantine_bytes: u64,
}

/// An unroll, and what is wrong with it.
#[derive(Debug)]
struct Refused {
    header: UnrollHeader,
    payload: Vec<u8>,
    reason: String,
}

/// The thread that writes invalid unrolls. Its drop waits until all are written.
#[derive(Debug)]
pub(crate) struct Quarantine {
    /// `None` only during the drop.
    queue: Option<SyncSender<Refused>>,
    thread: Option<JoinHandle<()>>,
    prometheus: Arc<Prometheus>,
}

impl Quarantine {
    /// The most unrolls in memory: those that wait, and the one being written.
    pub(crate) const HELD: usize = QUEUE + 1;

    /// Starts the thread, if invalid unrolls are kept at all.
    ///
    /// # Errors
    /// When the directory cannot be made or read, or the system gives no thread.
    pub(crate) fn start(options: &QuarantineArguments, prometheus: &Arc<Prometheus>) -> Result<Option<Self>> {
        let Some(directory) = options.quarantine.clone() else { return Ok(None) };
        fs::create_dir_all(&directory).map_err(Error::file("make", &directory))?;
        let taken = taken(&directory).map_err(Error::file("list", &directory))?;
        let (queue, refused) = sync_channel(QUEUE);
        let mut place = Directory { room: options.quarantine_bytes.saturating_sub(taken), directory };
        let thread = std::thread::Builder::new()
            .name("quarantine".into())
            .spawn({
                let prometheus = prometheus.clone();
                move || place.keep_all(&refused, &prometheus)
            })
            .map_err(Error::system("cannot start the quarantine's thread"))?;
        Ok(Some(Self { queue: Some(queue), thread: Some(thread), prometheus: prometheus.clone() }))
    }

    /// Queues an unroll for the disk, or counts it as discarded. Never waits.
    pub(crate) fn offer(&self, header: &UnrollHeader, payload: &Pieces, reason: &Invalid) {
        // A copy, because the pieces would keep larger buffers in memory until the disk is ready.
        let mut bytes = vec![0; payload.len()];
        payload.copy_to(0, &mut bytes);
        let refused = Refused { header: header.clone(), payload: bytes, reason: reason.to_string() };
        if self.queue.as_ref().is_none_or(|queue| queue.try_send(refused).is_err()) {
            self.prometheus.quarantined.of("busy").inc();
        }
    }
}

impl Drop for Quarantine {
    fn drop(&mut self) {
        drop(self.queue.take());
        if let Some(thread) = self.thread.take() {
            // If the thread panicked, it has nothing more to write.
            let _ = thread.join();
        }
    }
}

/// The directory, and the bytes that it may still take.
#[derive(Debug)]
struct Directory {
    directory: PathBuf,
    room: u64,
}

impl Directory {
    /// Writes the unrolls of the queue until it is closed.
    fn keep_all(&mut self, queue: &Receiver<Refused>, prometheus: &Prometheus) {
        let log_limiter = LogLimiter::default();
        while let Ok(refused) = queue.recv() {
            let result = match self.keep(&refused) {
                Ok(true) => "kept",
                Ok(false) => "full",
                Err(error) => {
                    if let Some(unreported) = log_limiter.due(()) {
                        tracing::error!(unreported, "an invalid unroll is not kept: {}", chain(&error));
                    }
                    "failed"
                }
            };
            prometheus.quarantined.of(result).inc();
        }
    }

    /// Writes one unroll. False when there is no room for it.
    fn keep(&mut self, refused: &Refused) -> Result<bool> {
        let Refused { header, payload, reason } = refused;
        let hash = hex::encode(&header.layout_hash[..header.layout_hash.len().min(HASH)]);
        let label = json!({
            "reason": reason,
            "actor": header.actor,
            "incarnation": format!("{:016x}", header.incarnation),
            "sequence": header.sequence,
            "learner_epoch": header.learner_epoch,
            "version": header.version,
            "layout_hash": hash,
            "episodes": header.episodes.len(),
            "payload_bytes": payload.len(),
        })
        .to_string();
        let length = (label.len() as u64).to_le_bytes();
        let bytes = (length.len() + label.len() + payload.len()) as u64;
        let Some(room) = self.room.checked_sub(bytes) else { return Ok(false) };
        let UnrollHeader { learner_epoch, actor, sequence, .. } = header;
        let path = self.directory.join(format!("{learner_epoch}-{actor}-{sequence}.unroll"));
        let written = write(&path, &[&length, label.as_bytes(), payload]);
        if written.is_err() {
            // A part of an unroll is of no use.
            let _ = fs::remove_file(&path);
        } else {
            self.room = room;
        }
        written.map(|()| true).map_err(Error::file("write", path))
    }
}

fn write(path: &Path, parts: &[&[u8]]) -> std::io::Result<()> {
    let mut file = File::create_new(path)?;
    parts.iter().try_for_each(|part| file.write_all(part))
}

/// Bytes of the unrolls that are in the directory.
fn taken(directory: &Path) -> std::io::Result<u64> {
    let mut bytes = 0u64;
    for entry in fs::read_dir(directory)? {
        let entry = entry?;
        if entry.path().extension().is_some_and(|extension| extension == "unroll") {
            bytes = bytes.saturating_add(entry.metadata()?.len());
        }
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(directory: &Path, bytes: u64) -> QuarantineArguments {
        QuarantineArguments { quarantine: Some(directory.to_path_buf()), quarantine_bytes: bytes }
    }

    fn header(sequence: u64) -> UnrollHeader {
        UnrollHeader { actor: 7, sequence, learner_epoch: 3, layout_hash: vec![0xab; 1000], ..Default::default() }
    }

    /// Offers unrolls of 1000 bytes one by one, and returns how many were kept.
    fn kept(directory: &Path, bytes: u64, sequences: std::ops::Range<u64>) -> u64 {
        let prometheus = Arc::<Prometheus>::default();
        for sequence in sequences {
            // One quarantine for each, so that the thread is never busy.
            let quarantine = Quarantine::start(&options(directory, bytes), &prometheus).unwrap().unwrap();
            quarantine.offer(
                &header(sequence),
                &bytes::Bytes::from(vec![sequence as u8; 1000]).into(),
                &Invalid::Header,
            );
        }
        prometheus.quarantined.of("kept").get()
    }

    #[test]
    fn a_refused_unroll_is_kept_with_its_header_and_the_reason() {
        let directory = tempfile::tempdir().unwrap();
        assert_eq!(kept(directory.path(), 1 << 20, 5..6), 1);
        let file = fs::read(directory.path().join("3-7-5.unroll")).unwrap();
        let (length, rest) = file.split_first_chunk().unwrap();
        let (label, payload) = rest.split_at(u64::from_le_bytes(*length) as usize);
        let label: serde_json::Value = serde_json::from_slice(label).unwrap();
        assert_eq!(label["reason"], Invalid::Header.to_string());
        assert_eq!((&label["sequence"], &label["payload_bytes"]), (&json!(5), &json!(1000)));
        assert_eq!(label["layout_hash"].as_str().unwrap().len(), 64);
        assert_eq!(payload, [5; 1000]);
    }

    #[test]
    fn all_unrolls_together_stay_below_the_limit_also_after_a_restart() {
        let directory = tempfile::tempdir().unwrap();
        assert_eq!(kept(directory.path(), 4000, 0..2), 2);
        assert_eq!(kept(directory.path(), 4000, 2..9), 1);
        assert!(taken(directory.path()).unwrap() <= 4000);
    }

    #[test]
    fn a_disk_error_costs_only_the_unroll() {
        let directory = tempfile::tempdir().unwrap();
        // A directory has the name of the file.
        fs::create_dir(directory.path().join("3-7-0.unroll")).unwrap();
        assert_eq!(kept(directory.path(), 1 << 20, 0..2), 1);
        assert!(directory.path().join("3-7-1.unroll").is_file());
    }

    #[test]
    fn an_unroll_is_discarded_and_counted_while_the_disk_is_busy() {
        let prometheus = Arc::<Prometheus>::default();
        // No thread takes an unroll from the queue.
        let (queue, _waiting) = sync_channel(QUEUE);
        let quarantine = Quarantine { queue: Some(queue), thread: None, prometheus: prometheus.clone() };
        for sequence in 0..QUEUE as u64 + 3 {
            quarantine.offer(&header(sequence), &Pieces::default(), &Invalid::Header);
        }
        assert_eq!(prometheus.quarantined.of("busy").get(), 3);
    }
}
