//! The films of a run, within a budget of bytes.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Most bytes of all films. Evaluations come every two minutes for weeks, and the volume belongs to the checkpoints.
const BUDGET: u64 = 64 << 20;

/// `RUN/films`: a film is named by the updates of its checkpoint.
#[derive(Debug)]
pub(super) struct Films {
    run: PathBuf,
    budget: u64,
}

/// A film on the disk.
struct Film {
    updates: u64,
    path: PathBuf,
    bytes: u64,
}

impl Films {
    /// The films of `run`.
    pub(super) fn new(run: &Path) -> Self {
        Self { run: run.to_path_buf(), budget: BUDGET }
    }

    fn directory(&self) -> PathBuf {
        self.run.join("films")
    }

    /// The path of a film within the run's directory.
    pub(super) fn path(updates: u64) -> String {
        format!("films/{updates:010}.gif")
    }

    /// Whether there is a film of the checkpoint after so many updates.
    pub(super) fn has(&self, updates: u64) -> bool {
        self.run.join(Self::path(updates)).is_file()
    }

    /// Writes `UPDATES.gif`, with as many digits as the name of the checkpoint. Beyond the budget it first removes others where
    /// they are closest, but not that of the `best` evaluation.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(super) fn write(&self, updates: u64, film: &[u8], best: Option<u64>) -> io::Result<()> {
        fs::create_dir_all(self.directory())?;
        self.make_room(updates, film.len() as u64, best)?;
        let path = self.run.join(Self::path(updates));
        let written = fs::write(&path, film);
        if written.is_err() {
            // Half a film would look like a whole one.
            drop(fs::remove_file(&path));
        }
        written
    }

    fn make_room(&self, updates: u64, bytes: u64, best: Option<u64>) -> io::Result<()> {
        let mut films = self.list()?;
        films.retain(|film| film.updates != updates);
        let mut taken: u64 = films.iter().map(|film| film.bytes).sum();
        while taken + bytes > self.budget {
            let number = |place: usize| films.get(place).map_or(updates, |film| film.updates);
            let gap = |place: &usize| number(place + 1).saturating_sub(place.checked_sub(1).map_or(0, number));
            let candidates = (0..films.len()).filter(|place| Some(films[*place].updates) != best);
            let Some(place) = candidates.min_by_key(gap) else { break };
            let film = films.remove(place);
            fs::remove_file(film.path)?;
            taken -= film.bytes;
        }
        Ok(())
    }

    /// The films, oldest first. Other files are not this learner's.
    fn list(&self) -> io::Result<Vec<Film>> {
        let mut films = Vec::new();
        for entry in fs::read_dir(self.directory())? {
            let path = entry?.path();
            let updates = path.extension().filter(|extension| *extension == "gif").and(path.file_stem());
            if let Some(updates) = updates.and_then(|stem| stem.to_str()?.parse().ok()) {
                let bytes = path.metadata()?.len();
                films.push(Film { updates, path, bytes });
            }
        }
        films.sort_unstable_by_key(|film| film.updates);
        Ok(films)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn films_beyond_the_budget_are_thinned_and_the_best_and_the_newest_stay() {
        let run = tempfile::tempdir().unwrap();
        let films = Films { budget: 50, ..Films::new(run.path()) };
        for updates in 1..=100 {
            films.write(updates, &[0; 10], Some(37).filter(|best| *best <= updates)).unwrap();
        }
        let kept: Vec<u64> = films.list().unwrap().iter().map(|film| film.updates).collect();
        assert_eq!((kept.len(), kept[4]), (5, 100));
        assert!(kept.contains(&37), "{kept:?}");
        assert!(kept.windows(2).all(|pair| pair[1] - pair[0] <= 50), "they cover the run: {kept:?}");
    }

    #[test]
    fn a_film_larger_than_the_budget_is_kept_alone() {
        let run = tempfile::tempdir().unwrap();
        let films = Films { budget: 50, ..Films::new(run.path()) };
        films.write(1, &[0; 10], None).unwrap();
        films.write(2, &[0; 60], None).unwrap();
        films.write(2, &[0; 60], None).unwrap();
        assert_eq!(films.list().unwrap().iter().map(|film| film.updates).collect::<Vec<_>>(), [2]);
    }
}
