//! Curves and images for TensorBoard: `RUN/tensorboard/events.out.tfevents.…`, a file for each learner epoch.
//!
//! A file is a sequence of records. A record is a length, its checksum, a message and the message's checksum (TensorFlow's
//! `record_writer.cc`).

mod experiment;
mod messages;

use std::fs;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use comic_experiment::Experiment;
use prost::Message as _;
use serde_json::Value;

use crate::error::{Error, Result};
use crate::observe::whole::Whole;
use messages::{Event, SessionLog, Summary};

pub(super) use messages::SummaryValue;

/// The version that a reader expects in the first record.
const VERSION: &str = "brain.Event:2";
/// `SessionLog.SessionStatus.START`: a reader discards what earlier files have of this step and later ones.
const START: i32 = 1;
/// Added to a checksum, so that data may contain checksums of itself (`crc32c.h`).
const MASK: u32 = 0xa282_ead8;
/// The fields of a line that give its position, and are not curves.
const POSITION: [&str; 3] = ["environment_steps", "seconds", "learner_epoch"];
/// Most values of one record, and bytes of their tags. Reports come from the network, and nested names multiply.
const MOST_VALUES: usize = 4096;
const LONGEST_TAG: usize = 256;
/// Most bytes of a run's files. A line every five seconds is 40 MB a day, and films are added to that.
const BUDGET: u64 = 256 << 20;
/// How often the distance between two lines, or two pictures, doubles until the budget is used up.
const DOUBLINGS: u64 = 8;

/// The file of one learner epoch.
#[derive(Debug)]
pub(crate) struct Events {
    file: Whole,
    /// Bytes of all files of the run.
    spent: u64,
    budget: u64,
    /// Lines and pictures that were left out since the last one.
    skipped_lines: u64,
    skipped_pictures: u64,
}

impl Events {
    /// Begins the file of learner epoch `epoch`, which continues after so many environment steps.
    ///
    /// # Errors
    /// When it cannot be written.
    pub(crate) fn begin(run: &Path, epoch: u64, environment_steps: u64) -> Result<Self> {
        let directory = run.join("tensorboard");
        // TensorBoard reads the files of a directory in alphabetical order.
        let path = directory.join(format!("events.out.tfevents.{epoch:010}"));
        let first = step(environment_steps).saturating_add(1);
        let open = || {
            fs::create_dir_all(&directory)?;
            let mut file = Whole::open(&path)?;
            let spent = bytes_below(&directory)?;
            file.append(&opening(now(), first))?;
            Ok::<_, std::io::Error>(Self { file, spent, budget: BUDGET, skipped_lines: 0, skipped_pictures: 0 })
        };
        open().map_err(Error::file("write", &path))
    }

    /// Writes the experiment: a row of TensorBoard's table of runs, and its text. An epoch begins with it.
    ///
    /// # Errors
    /// When the disk refuses, or the experiment has a number that TOML cannot write.
    pub(crate) fn write_experiment(&mut self, environment_steps: u64, experiment: &Experiment) -> Result<()> {
        let wall_time = now();
        let values = experiment::values(experiment, wall_time)?;
        let record = summary(wall_time, step(environment_steps), values);
        self.append(&record).map_err(Error::system("the file cannot be written"))
    }

    /// Writes every number of a line, by its path within the line, over environment steps. The larger the files are, the more
    /// lines are left out.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(crate) fn write(&mut self, line: &Value) -> std::io::Result<()> {
        if !is_due(&mut self.skipped_lines, self.spent, self.budget) {
            return Ok(());
        }
        self.append(&scalars(now(), line))
    }

    /// Writes points and images at this number of environment steps. The larger the files are, the more images are left out.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(super) fn write_values(
        &mut self,
        environment_steps: u64,
        mut values: Vec<SummaryValue>,
    ) -> std::io::Result<()> {
        if !is_due(&mut self.skipped_pictures, self.spent, self.budget) {
            values.retain(|value| value.image.is_none());
        }
        if values.is_empty() || self.spent >= self.budget {
            return Ok(());
        }
        self.append(&summary(now(), step(environment_steps), values))
    }

    fn append(&mut self, record: &[u8]) -> std::io::Result<()> {
        self.file.append(record)?;
        self.spent += record.len() as u64;
        Ok(())
    }
}

/// Whether the next line or picture is written, after `skipped` that were not. Beyond the budget none is.
fn is_due(skipped: &mut u64, spent: u64, budget: u64) -> bool {
    let due = spent < budget && *skipped + 1 >= 1 << (DOUBLINGS * spent / budget);
    *skipped = if due { 0 } else { *skipped + 1 };
    due
}

/// Bytes of the files in a directory.
fn bytes_below(directory: &Path) -> std::io::Result<u64> {
    fs::read_dir(directory)?.map(|entry| Ok(entry?.metadata()?.len())).sum()
}

/// The beginning of a file whose first step is `step`.
fn opening(wall_time: f64, step: i64) -> Vec<u8> {
    let first = Event { wall_time, file_version: Some(VERSION.to_owned()), ..Event::default() };
    let start = Event { wall_time, step, session_log: Some(SessionLog { status: START }), ..Event::default() };
    [record(&first), record(&start)].concat()
}

fn scalars(wall_time: f64, line: &Value) -> Vec<u8> {
    let step = line["environment_steps"].as_i64().unwrap_or_default();
    summary(wall_time, step, points("", line))
}

fn summary(wall_time: f64, step: i64, values: Vec<SummaryValue>) -> Vec<u8> {
    record(&Event { wall_time, step, summary: Some(Summary { values }), ..Event::default() })
}

/// A checkpoint or a report may claim any number of steps.
fn step(environment_steps: u64) -> i64 {
    i64::try_from(environment_steps).unwrap_or(i64::MAX)
}

fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

/// A point for each number below `value`, by its path within `value` below `tag`. Beyond 4,096 points, or 256 bytes of a tag,
/// there are none.
pub(super) fn points(tag: &str, value: &Value) -> Vec<SummaryValue> {
    let mut values = Vec::new();
    collect(tag, value, &mut values);
    values
}

fn collect(path: &str, value: &Value, values: &mut Vec<SummaryValue>) {
    if path.len() > LONGEST_TAG || values.len() == MOST_VALUES {
        return;
    }
    match value {
        Value::Number(number) if !POSITION.contains(&path) => {
            values.extend(number.as_f64().map(|number| SummaryValue::scalar(path.to_owned(), number)));
        }
        Value::Object(entries) => {
            for (name, value) in entries {
                let path = if path.is_empty() { name.clone() } else { format!("{path}/{name}") };
                collect(&path, value, values);
            }
        }
        _ => {}
    }
}

fn record(event: &Event) -> Vec<u8> {
    let message = event.encode_to_vec();
    let length = (message.len() as u64).to_le_bytes();
    let (of_length, of_message) = (checksum(&length).to_le_bytes(), checksum(&message).to_le_bytes());
    [&length[..], &of_length, &message, &of_message].concat()
}

fn checksum(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(MASK)
}

/// The steps and values of the file of learner epoch `epoch`, record by record.
#[cfg(test)]
pub(super) fn read(run: &Path, epoch: u64) -> Vec<(i64, Vec<SummaryValue>)> {
    let values = |event: Event| (event.step, event.summary.unwrap_or_default().values);
    tests::events(run, epoch).into_iter().map(values).collect()
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use serde_json::json;

    use super::*;

    /// TensorBoard 2.20's own `RecordWriter` wrote this, of its own `event_pb2` and `summary_pb2`.
    const THEIRS: &str = "1800000000000000a37f4b2209000000000000f83f1a0d627261696e2e4576656e743a322a28646c\
        0f000000000000006d532b0909000000000000f83f10403a020801a94dbe8f\
        3e00000000000000d9d240e709000000000000f83f10402a310a1f0a187461736b732f6765742d75702f686561645f68656967687415\
        0000003f0a0e0a077570646174657315000000003ffbdbbf";

    /// The messages of a file.
    pub(super) fn events(run: &Path, epoch: u64) -> Vec<Event> {
        let bytes = fs::read(run.join(format!("tensorboard/events.out.tfevents.{epoch:010}"))).unwrap();
        let mut rest = bytes.as_slice();
        let mut events = Vec::new();
        // A record is eight bytes of length and four of checksum, the message, and four more.
        while let Some((length, after)) = rest.split_first_chunk::<8>() {
            let (message, after) = after[4..].split_at(u64::from_le_bytes(*length) as usize);
            events.push(Event::decode(message).unwrap());
            rest = &after[4..];
        }
        events
    }

    #[test]
    fn lines_and_pictures_become_rarer_until_the_budget_is_used_up() {
        let run = tempfile::tempdir().unwrap();
        let mut events = Events { budget: 8 << 10, ..Events::begin(run.path(), 1, 0).unwrap() };
        let picture = || vec![SummaryValue::image("film", (1, 1), vec![0; 20].into())];
        for steps in 1..10_000 {
            events.write(&json!({"environment_steps": steps, "reward": 0.5})).unwrap();
            events.write_values(steps, picture()).unwrap();
        }
        let steps: Vec<i64> = super::tests::events(run.path(), 1)
            .into_iter()
            .filter(|event| {
                event.summary.as_ref().is_some_and(|summary| summary.values.iter().any(|value| value.image.is_some()))
            })
            .map(|event| event.step)
            .collect();
        assert!(steps.starts_with(&[1, 2, 3]), "{steps:?}");
        let gaps: Vec<i64> = steps.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(gaps.is_sorted() && gaps.last() >= Some(&8), "{gaps:?}");
        let length =
            fs::read_dir(run.path().join("tensorboard")).unwrap().next().unwrap().unwrap().metadata().unwrap().len();
        assert!((8 << 10..9 << 10).contains(&length), "{length}");
    }

    #[test]
    fn every_number_of_a_line_is_a_curve_as_tensorboard_writes_it() {
        let line = json!({"environment_steps": 64, "seconds": 1.0, "updates": 0, "episode_return": null,
            "tasks": {"get-up": {"head_height": 0.5}}, "name": "walk"});
        assert_eq!(hex::encode([opening(1.5, 64), scalars(1.5, &line)].concat()), THEIRS);
    }

    #[test]
    fn an_epoch_begins_by_discarding_every_step_after_its_checkpoint() {
        let run = tempfile::tempdir().unwrap();
        Events::begin(run.path(), 2, 4096).unwrap();
        let [_, event]: [Event; 2] = events(run.path(), 2).try_into().unwrap();
        assert_eq!((event.step, event.session_log), (4097, Some(SessionLog { status: START })));
    }

    #[test]
    fn an_image_is_written_with_its_size_beside_a_point() {
        let run = tempfile::tempdir().unwrap();
        let image = SummaryValue::image("film", (3, 2), Bytes::from_static(b"GIF89a"));
        // The fields by hand: the tag; the image with height 2, width 3, colour space 3 and the file.
        let bytes = *b"\x0a\x04film\x22\x0e\x08\x02\x10\x03\x18\x03\x22\x06GIF89a";
        assert_eq!(image.encode_to_vec(), bytes);
        let values = vec![SummaryValue::scalar("reward".into(), 0.5), image];
        Events::begin(run.path(), 1, 0).unwrap().write_values(u64::MAX, values.clone()).unwrap();
        assert_eq!(read(run.path(), 1).last(), Some(&(i64::MAX, values)));
    }

    #[test]
    fn a_report_cannot_make_a_record_large() {
        let wide: serde_json::Map<String, Value> =
            (0..5000).map(|number| (number.to_string(), json!(number))).collect();
        assert_eq!(points("evaluation", &json!(wide)).len(), MOST_VALUES);
        let deep = json!({ ("x".repeat(LONGEST_TAG)): wide, "reward": 1 });
        assert_eq!(points("", &deep), [SummaryValue::scalar("reward".into(), 1.0)]);
    }
}
