//! Keeps the evaluations that actors report: lines of `RUN/evaluations.jsonl`, films in `RUN/films`, and curves and images
//! for TensorBoard.

use std::io;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use crate::error::{Error, Result};
use crate::observe::evaluation::Evaluation;
use crate::observe::evaluation_history::{EvaluationHistory, Summary, clips};
use crate::observe::films::Films;
use crate::observe::lines;
use crate::observe::tensorboard::{Events, SummaryValue, points};
use crate::observe::whole::Whole;

/// Most clips that have a curve each. With more, TensorBoard's list of curves is hard to use.
const MOST_CLIP_CURVES: usize = 64;

/// Writes evaluations, and remembers what is shown of them.
#[derive(Debug)]
pub(super) struct EvaluationWriter {
    lines: PathBuf,
    films: Films,
    history: EvaluationHistory,
}

impl EvaluationWriter {
    /// Writes into the directory `run`.
    pub(super) fn new(run: &Path) -> Self {
        let lines = run.join("evaluations.jsonl");
        let mut writer = Self { films: Films::new(run), history: EvaluationHistory::new(), lines };
        writer.recall().unwrap_or_else(|error| tracing::error!("{}: {error}", writer.lines.display()));
        writer
    }

    /// Remembers the evaluations that the run has. A line that cannot be read is left out.
    fn recall(&mut self) -> io::Result<()> {
        let (films, history) = (&self.films, &mut self.history);
        lines::for_each(&self.lines, |line| {
            let line: Value = serde_json::from_slice(line).unwrap_or_default();
            let Some(updates) = line["updates"].as_u64() else { return };
            let evaluation = Evaluation {
                updates,
                epoch: line["learner_epoch"].as_u64().unwrap_or_default(),
                environment_steps: line["environment_steps"].as_u64().unwrap_or_default(),
                seconds: line["seconds"].as_f64().unwrap_or_default(),
                ..Evaluation::default()
            };
            history.add(&evaluation, &line["evaluation"]);
            if films.has(updates) {
                history.add_film();
            }
        })
    }

    /// What is shown of the evaluations.
    pub(super) fn summary(&self) -> Summary<'_> {
        self.history.summary(&self.films)
    }

    /// Keeps an evaluation. What the disk refuses is logged, and the rest is kept. A report or a film that is not as expected
    /// is shown as far as it can be.
    ///
    /// An evaluation that does not know its environment steps has no place in a curve, so TensorBoard does not show it.
    pub(super) fn keep(&mut self, evaluation: &Evaluation, events: Option<&mut Events>) {
        let version = evaluation.version;
        let report: Value = serde_json::from_str(&evaluation.json).unwrap_or_default();
        if let Err(error) = self.append(evaluation, &report) {
            tracing::error!(version, "an evaluation is lost: {}", comic_proto::chain(&error));
        }
        self.history.add(evaluation, &report);
        let film_size = gif_size(&evaluation.film);
        if film_size.is_some() {
            match self.films.write(evaluation.updates, &evaluation.film, self.history.best()) {
                Ok(()) => self.history.add_film(),
                Err(error) => tracing::error!(version, "an evaluation's film is lost: {error}"),
            }
        } else if !evaluation.film.is_empty() {
            tracing::warn!(version, "an evaluation's film is ignored, because it is no GIF");
        }
        if let Some(events) = events.filter(|_| evaluation.has_place())
            && let Err(error) = self.show(evaluation, &report, film_size, events)
        {
            tracing::error!(version, "TensorBoard's file lacks an evaluation: {error}");
        }
    }

    fn append(&self, evaluation: &Evaluation, report: &Value) -> Result<()> {
        let line = json!({
            "run": evaluation.run,
            "learner_epoch": evaluation.epoch,
            "version": evaluation.version,
            "updates": evaluation.updates,
            "environment_steps": evaluation.environment_steps,
            "seconds": evaluation.seconds,
            "evaluation": report,
        });
        let appended =
            Whole::open_lines(&self.lines).and_then(|mut lines| lines.append(format!("{line}\n").as_bytes()));
        appended.map_err(Error::file("write", &self.lines))
    }

    /// Writes curves, the film and the heat map of all evaluations for TensorBoard.
    fn show(
        &self,
        evaluation: &Evaluation,
        report: &Value,
        film_size: Option<(u16, u16)>,
        events: &mut Events,
    ) -> io::Result<()> {
        let mut values = points("evaluation", &report["overall"]);
        let clips = clips(report);
        if clips.len() <= MOST_CLIP_CURVES {
            let tag = |clip: &str| format!("evaluation_clips/{clip}/normalised_reward");
            values.extend(clips.iter().map(|(clip, reward, _)| SummaryValue::scalar(tag(clip), *reward)));
        }
        if let Some(size) = film_size {
            values.push(SummaryValue::image("evaluation/film", size, evaluation.film.clone()));
        }
        if clips.len() > 1 {
            let picture = self.history.heat_map().draw()?;
            values.push(SummaryValue::image("evaluation/clips", picture.size, picture.bytes.into()));
        }
        events.write_values(evaluation.environment_steps, values)
    }
}

/// Width and height of a GIF, pixels, from its header. `None` if the bytes do not begin like a GIF; nothing else is checked.
fn gif_size(film: &[u8]) -> Option<(u16, u16)> {
    match *film.first_chunk::<10>()? {
        [b'G', b'I', b'F', b'8', b'7' | b'9', b'a', w0, w1, h0, h1] => {
            Some((u16::from_le_bytes([w0, w1]), u16::from_le_bytes([h0, h1])))
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use bytes::Bytes;

    use super::*;
    use crate::observe::tensorboard;

    /// The header of a GIF of 3 × 2 pixels, and what might follow.
    const FILM: &[u8] = b"GIF89a\x03\x00\x02\x00and so on";

    /// An evaluation after so many updates, with these clips and their normalised rewards.
    fn evaluation(updates: u64, clips: &[(&str, f64)]) -> Evaluation {
        let clip = |(clip, reward): &(&str, f64)| json!({ "clip": clip, "normalised_reward": reward });
        let report = json!({
            "deterministic": true,
            "clips": clips.iter().map(clip).collect::<Vec<_>>(),
            "overall": { "clip": "overall", "normalised_reward": 0.5, "success_rate": 0.25,
                "measures": { "targets": 1.5 }, "tracking_error": { "position_mm": 30.0 },
                "reward_terms": { "pose": 0.75 } },
        });
        Evaluation {
            updates,
            environment_steps: 4096 * updates,
            seconds: 1.5,
            json: report.to_string(),
            film: Bytes::from_static(FILM),
            ..Evaluation::default()
        }
    }

    /// Keeps evaluations of a run, and returns the steps and values that TensorBoard reads of each.
    fn kept(run: &Path, evaluations: &[Evaluation]) -> Vec<(i64, Vec<SummaryValue>)> {
        let mut events = Events::begin(run, 1, 0).unwrap();
        let mut writer = EvaluationWriter::new(run);
        evaluations.iter().for_each(|evaluation| writer.keep(evaluation, Some(&mut events)));
        // Two records begin the file.
        tensorboard::read(run, 1).split_off(2)
    }

    fn value<'a>(values: &'a [SummaryValue], tag: &str) -> Option<&'a SummaryValue> {
        values.iter().find(|value| value.tag == tag)
    }

    #[test]
    fn an_evaluation_is_a_line_a_film_curves_and_images() {
        let run = tempfile::tempdir().unwrap();
        let records = kept(run.path(), &[evaluation(7, &[("walk", 0.125), ("run", 1.0)])]);
        let line = fs::read_to_string(run.path().join("evaluations.jsonl")).unwrap();
        let line: Value = serde_json::from_str(&line).unwrap();
        assert_eq!((line["environment_steps"].as_u64(), line["seconds"].as_f64()), (Some(4096 * 7), Some(1.5)));
        assert_eq!(line["evaluation"]["clips"][1]["clip"], "run");
        assert_eq!(fs::read(run.path().join("films/0000000007.gif")).unwrap(), FILM);

        let [(step, values)] = records.as_slice() else { panic!("{} records", records.len()) };
        assert_eq!(*step, 4096 * 7);
        let points: Vec<_> =
            values.iter().filter_map(|value| Some((value.tag.as_str(), value.simple_value?))).collect();
        let expected: [(&str, f32); 7] = [
            ("evaluation/measures/targets", 1.5),
            ("evaluation/normalised_reward", 0.5),
            ("evaluation/reward_terms/pose", 0.75),
            ("evaluation/success_rate", 0.25),
            ("evaluation/tracking_error/position_mm", 30.0),
            ("evaluation_clips/walk/normalised_reward", 0.125),
            ("evaluation_clips/run/normalised_reward", 1.0),
        ];
        assert_eq!(points, expected);
        let film = value(values, "evaluation/film").unwrap().image.clone().unwrap();
        assert_eq!((film.width, film.height, film.colorspace), (3, 2, 3));
        assert_eq!(film.encoded_image_string, FILM);
        let map = value(values, "evaluation/clips").unwrap().image.clone().unwrap();
        assert!(map.encoded_image_string.starts_with(b"\x89PNG"));
    }

    #[test]
    fn the_heat_map_grows_by_a_column_with_each_evaluation() {
        let run = tempfile::tempdir().unwrap();
        let records = kept(run.path(), &[1, 2, 3].map(|updates| evaluation(updates, &[("walk", 0.5), ("run", 1.0)])));
        // The map has two rows, and its cells are square.
        let columns = |values: &[SummaryValue]| {
            let map = value(values, "evaluation/clips").unwrap().image.clone().unwrap();
            2 * map.width / map.height
        };
        assert_eq!(records.iter().map(|(_, values)| columns(values)).collect::<Vec<_>>(), [1, 2, 3]);
    }

    #[test]
    fn a_restarted_learner_continues_the_heat_map() {
        let run = tempfile::tempdir().unwrap();
        kept(run.path(), &[1, 2].map(|updates| evaluation(updates, &[("walk", 0.5), ("run", 1.0)])));
        let writer = EvaluationWriter::new(run.path());
        let steps: Vec<u64> = writer.history.heat_map().columns().map(|(steps, _)| steps).collect();
        assert_eq!(steps, [4096, 8192]);
    }

    #[test]
    fn many_clips_have_no_curves_and_a_single_one_has_no_heat_map() {
        let names: Vec<String> = (0..65).map(|number| format!("clip {number}")).collect();
        let many: Vec<(&str, f64)> = names.iter().map(|name| (name.as_str(), 0.5)).collect();
        let run = tempfile::tempdir().unwrap();
        let records = kept(run.path(), &[evaluation(1, &many), evaluation(2, &many[..64]), evaluation(3, &many[..1])]);
        let curves =
            |values: &[SummaryValue]| values.iter().filter(|value| value.tag.starts_with("evaluation_clips/")).count();
        let found: Vec<_> =
            records.iter().map(|(_, values)| (curves(values), value(values, "evaluation/clips").is_some())).collect();
        assert_eq!(found, [(0, true), (64, true), (1, false)]);
    }

    #[test]
    fn a_film_that_is_no_gif_is_not_written() {
        for film in [&b""[..], b"GIF89a\x03\x00\x02", b"GIF88a\x03\x00\x02\x00", b"\x89PNG\r\n\x1a\n\0\0\0\x0d"] {
            let run = tempfile::tempdir().unwrap();
            let evaluation = Evaluation { film: Bytes::from_static(film), ..evaluation(7, &[]) };
            let records = kept(run.path(), &[evaluation]);
            assert!(!run.path().join("films").exists(), "{film:?}");
            assert_eq!(value(&records[0].1, "evaluation/film"), None, "{film:?}");
            assert!(value(&records[0].1, "evaluation/success_rate").is_some(), "{film:?}");
        }
    }

    #[test]
    fn a_report_of_another_shape_costs_nothing_but_its_curves() {
        let long = "x".repeat(201);
        let clip = json!({ "clip": long, "normalised_reward": 1 });
        let reports = [
            "broken".to_owned(),
            "[3]".to_owned(),
            json!({ "clips": 3, "overall": [1, 2] }).to_string(),
            json!({ "clips": [null, 3, { "clip": 1 }, { "clip": "walk" }, clip], "overall": { "a": null } })
                .to_string(),
        ];
        for json in reports {
            let run = tempfile::tempdir().unwrap();
            let records = kept(run.path(), &[Evaluation { json: json.clone(), ..evaluation(7, &[]) }]);
            let tags: Vec<_> = records[0].1.iter().map(|value| value.tag.as_str()).collect();
            assert_eq!(tags, ["evaluation/film"], "{json}");
        }
    }

    #[test]
    fn an_evaluation_without_its_steps_is_kept_but_is_in_no_curve() {
        let run = tempfile::tempdir().unwrap();
        let unknown = Evaluation { environment_steps: 0, ..evaluation(7, &[]) };
        // The initial checkpoint has no steps, and its evaluation begins the curves.
        let records = kept(run.path(), &[unknown, evaluation(0, &[])]);
        assert_eq!(records.iter().map(|(step, _)| *step).collect::<Vec<_>>(), [0]);
        assert_eq!(fs::read_to_string(run.path().join("evaluations.jsonl")).unwrap().lines().count(), 2);
        assert_eq!(fs::read_dir(run.path().join("films")).unwrap().count(), 2);
    }

    #[test]
    fn a_full_disk_loses_the_film_and_nothing_else() {
        let run = tempfile::tempdir().unwrap();
        let film = run.path().join("films/0000000007.gif");
        fs::create_dir(run.path().join("films")).unwrap();
        // A device that is always full.
        std::os::unix::fs::symlink("/dev/full", &film).unwrap();
        assert_eq!(kept(run.path(), &[evaluation(7, &[])]).len(), 1);
        assert!(fs::symlink_metadata(film).is_err(), "half a film is left");
        assert!(run.path().join("evaluations.jsonl").exists());
    }
}
