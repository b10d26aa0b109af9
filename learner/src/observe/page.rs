//! `RUN/index.html`: a page about the run that needs no network and no other file than the films. It is made of `page/`.
//!
//! The page is below 2 MB, whatever is reported: its curves have at most 512 points each, its heat map and its tables at most
//! 256 clips, the names of which have at most 200 bytes.

mod writer;

use std::path::Path;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use comic_experiment::Experiment;
use comic_replay::Accounting;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::{Error, Result};
use crate::observe::evaluation_history::{LONGEST_NAME, Summary};
use crate::observe::lines;
use crate::observe::thinned::{Entry, Thinned};
use writer::PageWriter;

/// The page; the braces are replaced.
const HTML: &str = include_str!("page/page.html");
const CSS: &str = include_str!("page/page.css");
const JAVASCRIPT: &str = include_str!("page/page.js");
/// Most points of the curve of training.
const MOST_POINTS: usize = 512;
/// Bytes of the experiment that are shown. The longest preset has 5,000.
const LONGEST_EXPERIMENT: usize = 64 << 10;
/// How old a page of a run that goes on may become, but for one long gradient step.
const INTERVAL: Duration = Duration::from_secs(60);

/// The page of a run.
#[derive(Debug)]
pub(super) struct Page {
    /// The name of the run's directory.
    run: String,
    /// The experiment's name and TOML.
    name: String,
    experiment: String,
    progress: Progress,
    training: Thinned<Point>,
    /// When the last page was given to the writer.
    written: Option<Instant>,
    writer: PageWriter,
}

/// Whether the run goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum State {
    /// The learner trains, or waits for actors.
    Running,
    /// The learner ended with an error. The run may be resumed when the reason is gone.
    Failed,
    /// The learner was told to stop. The run may be resumed.
    Stopped,
    /// The budget is used up.
    Over,
}

/// The members of a line of metrics that the page shows.
#[derive(Clone, Debug, Default, Deserialize, Serialize)]
#[serde(default)]
struct Progress {
    learner_epoch: u64,
    updates: u64,
    environment_steps: u64,
    seconds: f64,
    accounting: Accounting,
    #[serde(skip_serializing)]
    episodes: u64,
    #[serde(skip_serializing)]
    normalised_reward: Option<f64>,
}

/// The mean over the episodes of some lines of metrics, at the place of the last one.
#[derive(Clone, Copy, Debug, Serialize)]
struct Point {
    #[serde(skip)]
    epoch: u64,
    environment_steps: u64,
    seconds: f64,
    normalised_reward: f64,
    #[serde(skip)]
    episodes: u64,
}

impl Entry for Point {
    fn place(&self) -> (u64, u64) {
        (self.epoch, self.environment_steps)
    }

    fn absorb(&mut self, newer: Self) {
        let episodes = self.episodes.saturating_add(newer.episodes);
        let share = newer.episodes as f64 / episodes.max(1) as f64;
        let normalised_reward = self.normalised_reward + share * (newer.normalised_reward - self.normalised_reward);
        *self = Self { episodes, normalised_reward, ..newer };
    }
}

/// What the page's script draws.
#[derive(Serialize)]
struct Contents<'a> {
    run: &'a str,
    name: &'a str,
    experiment: &'a str,
    state: State,
    /// Seconds since 1970.
    written: u64,
    progress: &'a Progress,
    training: Vec<&'a Point>,
    evaluations: Summary<'a>,
}

impl Page {
    /// The page of `run`, with what earlier learner epochs wrote to `metrics.jsonl`. A line that cannot be read is left out.
    ///
    /// # Errors
    /// When the experiment has a number that TOML cannot write.
    pub(super) fn open(run: &Path, experiment: &Experiment) -> Result<Self> {
        let name =
            std::path::absolute(run).ok().and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
        let mut page = Self {
            run: cut(name.unwrap_or_default(), LONGEST_NAME),
            name: cut(experiment.name.clone(), LONGEST_NAME),
            experiment: cut(experiment.to_toml()?, LONGEST_EXPERIMENT),
            progress: Progress::default(),
            training: Thinned::new(MOST_POINTS),
            written: None,
            writer: PageWriter::start(run.join("index.html")),
        };
        let metrics = run.join("metrics.jsonl");
        // A list would be read as the fields in their order.
        let progress = |line: &[u8]| line.starts_with(b"{").then(|| serde_json::from_slice(line).ok()).flatten();
        let read = lines::for_each(&metrics, |line| page.progress_to(progress(line)));
        read.unwrap_or_else(|error| tracing::error!("the page lacks earlier metrics: {}: {error}", metrics.display()));
        Ok(page)
    }

    /// Adds a line of metrics.
    pub(super) fn add(&mut self, line: &Value) {
        self.progress_to(Progress::deserialize(line).ok());
    }

    fn progress_to(&mut self, progress: Option<Progress>) {
        let Some(progress) = progress else { return };
        if let Some(normalised_reward) = progress.normalised_reward {
            self.training.add(Point {
                epoch: progress.learner_epoch,
                environment_steps: progress.environment_steps,
                seconds: progress.seconds,
                normalised_reward,
                episodes: progress.episodes,
            });
        }
        self.progress = progress;
    }

    /// Whether the page is old enough for another one.
    pub(super) fn is_due(&self) -> bool {
        self.written.is_none_or(|written| written.elapsed() >= INTERVAL)
    }

    /// Has the page written. A page that the disk refuses is logged, and is lost. While an earlier page waits for the disk, this one
    /// is left out and stays due; the last one is not.
    pub(super) fn write(&mut self, state: State, evaluations: Summary<'_>) {
        match self.render(state, evaluations) {
            Ok(page) if state == State::Running => {
                if self.writer.write(page) {
                    self.written = Some(Instant::now());
                }
            }
            Ok(page) => self.writer.write_last(page),
            Err(error) => tracing::error!("the page is not written: {}", comic_proto::chain(&error)),
        }
    }

    fn render(&self, state: State, evaluations: Summary<'_>) -> Result<Vec<u8>> {
        let contents = Contents {
            run: &self.run,
            name: &self.name,
            experiment: &self.experiment,
            state,
            written: SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs()),
            progress: &self.progress,
            training: self.training.iter().collect(),
            evaluations,
        };
        let contents = serde_json::to_string(&contents).map_err(Error::json("the page's contents"))?;
        // Names come from the network. Without `<`, none of them ends the script element.
        let contents = contents.replace('<', "\\u003c");
        let page = HTML.replacen("{css}", CSS, 1).replacen("{javascript}", JAVASCRIPT, 1);
        Ok(page.replacen("{contents}", &contents, 1).into_bytes())
    }
}

/// The text up to so many bytes.
fn cut(mut text: String, most: usize) -> String {
    text.truncate(text.floor_char_boundary(most));
    text
}

#[cfg(test)]
mod tests {
    use std::fs;

    use serde_json::json;

    use super::*;
    use crate::observe::evaluation::Evaluation;
    use crate::observe::evaluation_writer::EvaluationWriter;

    /// A GIF, as far as anyone looks.
    const FILM: &[u8] = b"GIF89a\x03\x00\x02\x00and so on";

    fn line(environment_steps: u64, normalised_reward: impl Into<Value>) -> Value {
        json!({ "learner_epoch": 1, "updates": environment_steps / 100, "environment_steps": environment_steps,
            "seconds": 5.0, "episodes": 2, "normalised_reward": normalised_reward.into(),
            "accounting": { "produced": 7, "trained": 4, "in_flight": 1, "duplicates": 0, "unattributed": 0,
                "dropped": { "stale": 2, "invalid": 0, "superseded": 0, "lost_at_restart": 0 } } })
    }

    /// An evaluation without noise, with the same normalised reward for each of these clips.
    fn evaluation(updates: u64, clips: &[&str], reward: f64) -> Evaluation {
        let means = |clip: &str| json!({ "clip": clip, "normalised_reward": reward, "success_rate": 0.5, "fraction_survived": 0.75 });
        let clips: Vec<_> = clips.iter().map(|clip| means(clip)).collect();
        let report = json!({ "deterministic": true, "clips": clips, "overall": means("overall") });
        Evaluation {
            epoch: 1,
            updates,
            environment_steps: 100 * updates,
            json: report.to_string(),
            film: FILM.into(),
            ..Evaluation::default()
        }
    }

    fn open(run: &Path) -> (Page, EvaluationWriter) {
        (Page::open(run, &Experiment::default()).unwrap(), EvaluationWriter::new(run))
    }

    /// Writes the page, and returns its text and what its script reads.
    fn written(mut page: Page, evaluations: &EvaluationWriter, run: &Path) -> (String, Value) {
        page.write(State::Over, evaluations.summary());
        drop(page);
        let text = fs::read_to_string(run.join("index.html")).unwrap();
        let (_, contents) = text.split_once("id=\"contents\">").unwrap();
        let contents = serde_json::from_str(contents.split_once("</script>").unwrap().0).unwrap();
        (text, contents)
    }

    #[test]
    fn the_page_holds_progress_curves_films_and_the_experiment() {
        let run = tempfile::tempdir().unwrap();
        let (mut page, mut writer) = open(run.path());
        page.add(&line(100, 0.25));
        page.add(&line(200, Value::Null));
        for (updates, reward) in [(1, 0.5), (2, 0.125)] {
            writer.keep(&evaluation(updates, &["walk", "run"], reward), None);
        }
        let (_, contents) = written(page, &writer, run.path());
        let point = json!({ "environment_steps": 100, "seconds": 5.0, "normalised_reward": 0.25 });
        assert_eq!(contents["training"], json!([point]), "a line without an episode is no point");
        assert_eq!(contents["progress"]["environment_steps"], 200);
        assert_eq!(contents["progress"]["accounting"]["dropped"]["stale"], 2);
        assert_eq!(contents["state"], "over");
        assert_eq!(contents["name"], "tracking-mlp");
        assert!(contents["experiment"].as_str().unwrap().contains("[vmpo]"));
        let evaluations = &contents["evaluations"];
        assert_eq!(evaluations["marks"].as_array().unwrap().len(), 2);
        let clip = json!({ "name": "run", "normalised_reward": 0.125, "success_rate": 0.5, "fraction_survived": 0.75 });
        assert_eq!(evaluations["newest"]["clips"][1], clip);
        assert_eq!((&evaluations["best"]["updates"], &evaluations["newest"]["updates"]), (&json!(1), &json!(2)));
        assert_eq!(evaluations["newest_film"]["path"], "films/0000000002.gif");
        assert_eq!(evaluations["best_film"]["path"], "films/0000000001.gif");
        assert_eq!(evaluations["heat_map_clips"], json!(["walk", "run"]));
        assert_eq!(evaluations["heat_map"], json!([[100, [128, 128]], [200, [33, 33]]]));
    }

    #[test]
    fn no_name_ends_the_script_element() {
        let run = tempfile::tempdir().unwrap();
        let (page, mut writer) = open(run.path());
        let hostile = "</script><script>alert(1)</script><!-- {javascript}";
        writer.keep(&evaluation(1, &[hostile, "walk"], 0.5), None);
        let (text, contents) = written(page, &writer, run.path());
        assert_eq!(contents["evaluations"]["heat_map_clips"], json!([hostile, "walk"]));
        assert!(!text.contains("alert(1)</script>"));
        assert_eq!(text.matches("</script>").count(), 2);
    }

    #[test]
    fn the_script_makes_no_html_of_text() {
        for sign in ["innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "fetch(", "import"] {
            assert!(!JAVASCRIPT.contains(sign), "{sign}");
        }
    }

    #[test]
    fn the_page_stays_below_two_megabytes() {
        let run = tempfile::tempdir().unwrap();
        let (mut page, mut writer) = open(run.path());
        page.experiment = cut("<".repeat(1 << 20), LONGEST_EXPERIMENT);
        page.name = cut("<".repeat(1 << 20), LONGEST_NAME);
        for steps in 0..10_000 {
            page.add(&line(steps, 1.0 / 3.0 + steps as f64));
        }
        let names: Vec<String> = (0..300).map(|number| format!("{number:<<200}")).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        for updates in 0..256 {
            let report =
                Evaluation { film: bytes::Bytes::new(), ..evaluation(updates, &names, 1.0 / (1 + updates) as f64) };
            writer.keep(&report, None);
        }
        let (text, contents) = written(page, &writer, run.path());
        assert!((1_000_000..2_000_000).contains(&text.len()), "{} bytes", text.len());
        assert!((256..=512).contains(&contents["training"].as_array().unwrap().len()));
        assert_eq!(contents["evaluations"]["newest"]["clips_left_out"], 300 - 256);
    }

    #[test]
    fn a_restarted_learner_keeps_the_history() {
        let run = tempfile::tempdir().unwrap();
        let (mut page, mut writer) = open(run.path());
        for updates in 1..=3 {
            writer.keep(&evaluation(updates, &["walk", "run"], 0.25 * updates as f64), None);
        }
        let lines = [line(100, 0.25), line(200, 0.5)];
        lines.iter().for_each(|line| page.add(line));
        let (_, mut before) = written(page, &writer, run.path());
        let text = format!("{}\nbroken\n\n{}\n[3]\n{{\"environment_steps\":30", lines[0], lines[1]);
        fs::write(run.path().join("metrics.jsonl"), text).unwrap();
        let (page, writer) = open(run.path());
        let (_, mut after) = written(page, &writer, run.path());
        // The moments of writing differ.
        assert!(before["written"].take().is_number() && after["written"].take().is_number());
        assert_eq!(before, after);
        assert_eq!(after["training"].as_array().unwrap().len(), 2);
    }

    #[test]
    fn a_page_is_due_at_first_and_when_the_last_one_is_a_minute_old() {
        let run = tempfile::tempdir().unwrap();
        let (mut page, writer) = open(run.path());
        assert!(page.is_due());
        page.write(State::Running, writer.summary());
        assert!(!page.is_due());
        page.written = Instant::now().checked_sub(INTERVAL);
        assert!(page.is_due());
    }

    #[test]
    fn the_newest_evaluation_is_the_best_one_or_is_not_also_for_the_same_checkpoint() {
        let run = tempfile::tempdir().unwrap();
        for (reward, is_best) in [(0.5, true), (0.25, false), (0.75, true)] {
            let (page, mut writer) = open(run.path());
            writer.keep(&evaluation(1, &["walk"], reward), None);
            let (_, contents) = written(page, &writer, run.path());
            assert_eq!(contents["evaluations"]["newest_is_best"], is_best, "{reward}");
        }
    }

    #[test]
    fn a_film_that_someone_removed_is_not_shown() {
        let run = tempfile::tempdir().unwrap();
        let (page, mut writer) = open(run.path());
        writer.keep(&evaluation(1, &["walk"], 0.5), None);
        fs::remove_dir_all(run.path().join("films")).unwrap();
        let (_, contents) = written(page, &writer, run.path());
        assert_eq!(contents["evaluations"]["newest_film"], Value::Null);
        assert_eq!(contents["evaluations"]["best_film"], Value::Null);
    }

    #[test]
    fn a_full_disk_costs_the_newer_page_and_nothing_else() {
        let run = tempfile::tempdir().unwrap();
        let (page, writer) = open(run.path());
        written(page, &writer, run.path());
        // A device that is always full.
        std::os::unix::fs::symlink("/dev/full", run.path().join(".index.html")).unwrap();
        let (mut page, writer) = open(run.path());
        page.add(&line(100, 0.25));
        let (_, contents) = written(page, &writer, run.path());
        assert_eq!(contents["progress"]["environment_steps"], 0, "the former page");
        assert!(fs::symlink_metadata(run.path().join(".index.html")).is_err(), "half a page is left");
        let (mut page, writer) = open(run.path());
        page.add(&line(100, 0.25));
        let (_, contents) = written(page, &writer, run.path());
        assert_eq!(contents["progress"]["environment_steps"], 100);
    }
}
