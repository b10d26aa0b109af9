//! What is shown of a run's evaluations: all of them as marks and as a heat map, the newest and the best one in full.

use serde::Serialize;
use serde_json::Value;

use crate::observe::evaluation::Evaluation;
use crate::observe::films::Films;
use crate::observe::heat_map::HeatMap;
use crate::observe::thinned::{Entry, Thinned};

/// Bytes of the longest name of a clip. Longer ones are not shown, because names come from the network.
pub(super) const LONGEST_NAME: usize = 200;
/// Most clips of an evaluation that are shown in full.
const MOST_CLIPS: usize = 256;
/// Most evaluations that are marks of a curve.
const MOST_MARKS: usize = 512;

/// The evaluations of a run, also those of earlier learner epochs. Its size is bounded.
#[derive(Debug)]
pub(super) struct EvaluationHistory {
    marks: Thinned<Mark>,
    heat_map: HeatMap,
    newest: Option<Shown>,
    best: Option<Shown>,
    /// The newest one with a film.
    filmed: Option<Mark>,
}

/// An evaluation in a few numbers.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Mark {
    #[serde(skip)]
    epoch: u64,
    updates: u64,
    environment_steps: u64,
    seconds: f64,
    #[serde(flatten)]
    means: Means,
}

/// Means over episodes; `None` where the report has no number.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Means {
    normalised_reward: Option<f64>,
    success_rate: Option<f64>,
    fraction_survived: Option<f64>,
}

/// An evaluation in full.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Shown {
    #[serde(flatten)]
    mark: Mark,
    clips: Vec<Clip>,
    /// Clips that are not among `clips`, because there are too many, or because they have no name or no reward.
    clips_left_out: usize,
}

/// The means of one clip.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Clip {
    name: String,
    #[serde(flatten)]
    means: Means,
}

/// A film and the evaluation that it shows.
#[derive(Debug, Serialize)]
struct Film<'a> {
    /// The path within the run's directory.
    path: String,
    #[serde(flatten)]
    mark: &'a Mark,
}

/// Everything that a page shows of the evaluations.
#[derive(Debug, Serialize)]
pub(super) struct Summary<'a> {
    marks: Vec<&'a Mark>,
    newest: Option<&'a Shown>,
    best: Option<&'a Shown>,
    /// The newest one is the best one. Another one of the same checkpoint may not be.
    newest_is_best: bool,
    newest_film: Option<Film<'a>>,
    best_film: Option<Film<'a>>,
    /// The rows of the heat map, and the environment steps and levels of each column.
    heat_map_clips: &'a [String],
    heat_map: Vec<(u64, &'a [u8])>,
}

impl Entry for Mark {
    fn place(&self) -> (u64, u64) {
        (self.epoch, self.environment_steps)
    }

    /// The newer one stands for both.
    fn absorb(&mut self, newer: Self) {
        *self = newer;
    }
}

impl Means {
    fn of(report: &Value) -> Self {
        let number = |name: &str| report[name].as_f64();
        Self {
            normalised_reward: number("normalised_reward"),
            success_rate: number("success_rate"),
            fraction_survived: number("fraction_survived"),
        }
    }
}

impl<'a> Film<'a> {
    /// The film of an evaluation, if it is there.
    fn of(mark: &'a Mark, films: &Films) -> Option<Self> {
        films.has(mark.updates).then(|| Self { path: Films::path(mark.updates), mark })
    }
}

impl EvaluationHistory {
    /// A history without evaluations.
    pub(super) fn new() -> Self {
        let (marks, heat_map) = (Thinned::new(MOST_MARKS), HeatMap::new());
        Self { marks, heat_map, newest: None, best: None, filmed: None }
    }

    /// Adds the newest evaluation, of which this is the report. The curve has those without noise.
    pub(super) fn add(&mut self, evaluation: &Evaluation, report: &Value) {
        let &Evaluation { epoch, updates, environment_steps, seconds, .. } = evaluation;
        // A report may claim any time.
        let seconds = if seconds.is_finite() { seconds } else { 0.0 };
        let mark = Mark { epoch, updates, environment_steps, seconds, means: Means::of(&report["overall"]) };
        let named = clips(report);
        if evaluation.has_place() {
            if report["deterministic"] == true && mark.means.normalised_reward.is_some() {
                self.marks.add(mark.clone());
            }
            if named.len() > 1 {
                let rewards: Vec<_> = named.iter().map(|(name, reward, _)| (*name, *reward)).collect();
                self.heat_map.add(mark.place(), &rewards);
            }
        }
        let in_report = report["clips"].as_array().map_or(0, Vec::len);
        let clip = |(name, _, clip): (&str, f64, &Value)| Clip { name: name.to_owned(), means: Means::of(clip) };
        let shown: Vec<_> = named.into_iter().take(MOST_CLIPS).map(clip).collect();
        let newest = Shown { mark, clips_left_out: in_report - shown.len(), clips: shown };
        let reward = newest.mark.means.normalised_reward;
        if reward.is_some() && self.best.as_ref().is_none_or(|best| reward > best.mark.means.normalised_reward) {
            self.best = Some(newest.clone());
        }
        self.newest = Some(newest);
    }

    /// Notes that the newest evaluation has a film.
    pub(super) fn add_film(&mut self) {
        self.filmed = self.newest.as_ref().map(|newest| newest.mark.clone());
    }

    /// The updates of the best evaluation.
    pub(super) fn best(&self) -> Option<u64> {
        self.best.as_ref().map(|best| best.mark.updates)
    }

    /// The normalised rewards of the clips over the evaluations.
    pub(super) fn heat_map(&self) -> &HeatMap {
        &self.heat_map
    }

    /// What a page shows, with the films that are there.
    pub(super) fn summary(&self, films: &Films) -> Summary<'_> {
        Summary {
            marks: self.marks.iter().collect(),
            newest: self.newest.as_ref(),
            best: self.best.as_ref(),
            newest_is_best: self.newest.is_some() && self.newest == self.best,
            newest_film: self.filmed.as_ref().and_then(|mark| Film::of(mark, films)),
            best_film: self.best.as_ref().and_then(|best| Film::of(&best.mark, films)),
            heat_map_clips: self.heat_map.clips(),
            heat_map: self.heat_map.columns().collect(),
        }
    }
}

/// The clips of a report that have a name and a normalised reward, in the report's order.
pub(super) fn clips(report: &Value) -> Vec<(&str, f64, &Value)> {
    let clips = report["clips"].as_array().into_iter().flatten();
    let named = clips.filter_map(|clip| Some((clip["clip"].as_str()?, clip["normalised_reward"].as_f64()?, clip)));
    named.filter(|(name, ..)| name.len() <= LONGEST_NAME).collect()
}
