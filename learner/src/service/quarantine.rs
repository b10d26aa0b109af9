//! Unrolls that were refused as invalid, on disk for whoever wants to know what was wrong with them.
//!
//! One file each, `EPOCH-ACTOR-SEQUENCE.unroll`: eight bytes, little-endian, with the length of a JSON object; that object,
//! which is the header in words and the reason; and the payload as it came.

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
use crate::observe::telemetry::Telemetry;

/// Unrolls that may wait for the disk; one more is let go of.
const QUEUE: usize = 8;
/// Of a layout hash that may be anything.
const HASH: usize = 32;

/// Where refused unrolls go.
#[derive(Clone, Debug, Default, Args)]
pub struct QuarantineOptions {
    /// Directory for unrolls that are refused as invalid, so that somebody can look at them; off unless given.
    #[arg(long, value_name = "DIR", help_heading = "Quarantine")]
    pub quarantine: Option<PathBuf>,
    /// Bytes they may take there in all, earlier ones included.
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

/// The thread that writes them. Dropped, it writes what still waits.
#[derive(Debug)]
pub(crate) struct Quarantine {
    /// `None` only while it is dropped.
    queue: Option<SyncSender<Refused>>,
    thread: Option<JoinHandle<()>>,
    telemetry: Arc<Telemetry>,
}

impl Quarantine {
    /// Unrolls held in memory at most: those that wait, and the one being written.
    pub(crate) const HELD: usize = QUEUE + 1;

    /// Starts the thread, if refused unrolls are to be kept.
    ///
    /// # Errors
    /// When the directory cannot be made or read, or the system gives no thread.
    pub(crate) fn start(options: &QuarantineOptions, telemetry: &Arc<Telemetry>) -> Result<Option<Self>> {
        let Some(directory) = options.quarantine.clone() else { return Ok(None) };
        fs::create_dir_all(&directory).map_err(Error::file("make", &directory))?;
        let taken = taken(&directory).map_err(Error::file("list", &directory))?;
        let (queue, refused) = sync_channel(QUEUE);
        let mut cell = Cell { room: options.quarantine_bytes.saturating_sub(taken), directory };
        let thread = std::thread::Builder::new()
            .name("quarantine".into())
            .spawn({
                let telemetry = telemetry.clone();
                move || cell.keep_all(&refused, &telemetry)
            })
            .map_err(Error::system("cannot start the quarantine's thread"))?;
        Ok(Some(Self { queue: Some(queue), thread: Some(thread), telemetry: telemetry.clone() }))
    }

    /// Has an unroll kept; never waits.
    pub(crate) fn offer(&self, header: &UnrollHeader, payload: &Pieces, reason: &Invalid) {
        // A copy: the pieces keep larger buffers, for as long as the disk takes.
        let mut bytes = vec![0; payload.len()];
        payload.copy_to(0, &mut bytes);
        let refused = Refused { header: header.clone(), payload: bytes, reason: reason.to_string() };
        if self.queue.as_ref().is_none_or(|queue| queue.try_send(refused).is_err()) {
            self.telemetry.quarantined.of("busy").inc();
        }
    }
}

impl Drop for Quarantine {
    fn drop(&mut self) {
        drop(self.queue.take());
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has nothing more to write.
            let _ = thread.join();
        }
    }
}

/// The directory, and the bytes that are left there.
#[derive(Debug)]
struct Cell {
    directory: PathBuf,
    room: u64,
}

impl Cell {
    fn keep_all(&mut self, queue: &Receiver<Refused>, telemetry: &Telemetry) {
        let log_limiter = LogLimiter::default();
        while let Ok(refused) = queue.recv() {
            let result = match self.keep(&refused) {
                Ok(true) => "kept",
                Ok(false) => "full",
                Err(error) => {
                    if let Some(unreported) = log_limiter.due(()) {
                        tracing::error!(unreported, "a refused unroll is not kept: {}", chain(&error));
                    }
                    "failed"
                }
            };
            telemetry.quarantined.of(result).inc();
        }
    }

    /// False when there is no room.
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
            "behaviour": header.behaviour().as_str_name(),
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
            // Half of it helps nobody.
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

/// Bytes of the unrolls that are there.
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

    fn options(directory: &Path, bytes: u64) -> QuarantineOptions {
        QuarantineOptions { quarantine: Some(directory.to_path_buf()), quarantine_bytes: bytes }
    }

    fn header(sequence: u64) -> UnrollHeader {
        UnrollHeader { actor: 7, sequence, learner_epoch: 3, layout_hash: vec![0xab; 1000], ..Default::default() }
    }

    /// Offers unrolls of 1000 bytes one by one; how many were kept.
    fn kept(directory: &Path, bytes: u64, sequences: std::ops::Range<u64>) -> u64 {
        let telemetry = Arc::<Telemetry>::default();
        for sequence in sequences {
            // Each on its own, so that none finds the thread busy.
            let quarantine = Quarantine::start(&options(directory, bytes), &telemetry).unwrap().unwrap();
            quarantine.offer(
                &header(sequence),
                &bytes::Bytes::from(vec![sequence as u8; 1000]).into(),
                &Invalid::Header,
            );
        }
        telemetry.quarantined.of("kept").get()
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
    fn all_together_never_take_more_than_they_may_not_even_after_a_restart() {
        let directory = tempfile::tempdir().unwrap();
        assert_eq!(kept(directory.path(), 4000, 0..2), 2);
        assert_eq!(kept(directory.path(), 4000, 2..9), 1);
        assert!(taken(directory.path()).unwrap() <= 4000);
    }

    #[test]
    fn a_disk_that_refuses_costs_the_unroll_and_nothing_else() {
        let directory = tempfile::tempdir().unwrap();
        // Where the file should be there is a directory.
        fs::create_dir(directory.path().join("3-7-0.unroll")).unwrap();
        assert_eq!(kept(directory.path(), 1 << 20, 0..2), 1);
        assert!(directory.path().join("3-7-1.unroll").is_file());
    }

    #[test]
    fn one_that_finds_the_disk_busy_is_let_go_of_and_counted() {
        let telemetry = Arc::<Telemetry>::default();
        // A thread that never takes one.
        let (queue, _waiting) = sync_channel(QUEUE);
        let quarantine = Quarantine { queue: Some(queue), thread: None, telemetry: telemetry.clone() };
        for sequence in 0..QUEUE as u64 + 3 {
            quarantine.offer(&header(sequence), &Pieces::default(), &Invalid::Header);
        }
        assert_eq!(telemetry.quarantined.of("busy").get(), 3);
    }
}
