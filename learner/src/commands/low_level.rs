//! `comic-learner low-level`: prints the card of a low level, or writes a low level with a new one.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;
use comic_clips::BUILTIN_TERMS;
use comic_networks::export::{
    Assessment, Card, ClipEvaluation, Evaluation, Exported, FittedPrior, Gate, RandomLatents,
};
use serde::de::DeserializeOwned;
use sha2::{Digest as _, Sha256};

use crate::error::{Error, Result};

/// Prints what a low level was learned from, how well, what it does with random latents, and how it is made again.
#[derive(Args, Debug)]
pub struct LowLevel {
    /// `builtin`, or a file of `comic-learner export --part low-level`.
    #[arg(value_name = "FILE|builtin")]
    low_level: PathBuf,
    /// JSON, the whole description in the file, instead of text.
    #[arg(long)]
    json: bool,
    /// Writes the low level to this file, too.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Gives the file of --out a new card, with this command, which makes such a low level again.
    #[arg(long, value_name = "COMMAND", requires = "out")]
    made_by: Option<String>,
    /// For the new card: what `comic-actor evaluate --deterministic --json` printed about the policy.
    #[arg(long, value_name = "FILE", requires = "made_by")]
    evaluation: Option<PathBuf>,
    /// For the new card: what `comic-actor assess --json` printed about the low level.
    #[arg(long, value_name = "FILE", requires = "made_by")]
    assessment: Option<PathBuf>,
    /// For the new card: the terms of the recordings that the low level was learned from. For built-in clips the program knows
    /// them.
    #[arg(long, value_name = "TEXT", requires = "made_by")]
    terms: Option<String>,
}

impl LowLevel {
    /// Writes the file if one is wanted, and prints its card.
    ///
    /// # Errors
    /// [`Error::Configuration`] when a file cannot be used, a disk that fails.
    pub fn run(&self) -> Result<()> {
        let of = |path: &Path| format!("cannot use {}", path.display());
        let found = Exported::open_or_builtin(&self.low_level).map_err(Error::from);
        let found = found.map_err(Error::within(of(&self.low_level)))?;
        let refused =
            |error: comic_networks::Error| Error::configuration(format!("{}: {error}", self.low_level.display()));
        found.describe_low_level(&mut found.experiment.network.clone()).map_err(refused)?;
        let file = match &self.made_by {
            Some(command) => found.with_card(self.card(command, &found)?).map_err(Error::from)?,
            None => found,
        };
        if let Some(out) = &self.out {
            std::fs::write(out, &file.bytes).map_err(Error::file("write", out))?;
        }
        let text = if self.json {
            serde_json::to_string_pretty(&file.spec).map_err(Error::json("the description"))? + "\n"
        } else {
            printable(&describe(&file))
        };
        std::io::stdout().write_all(text.as_bytes()).map_err(Error::system("cannot write to stdout"))
    }

    /// The new card.
    fn card(&self, command: &str, file: &Exported) -> Result<Card> {
        let evaluation = self.evaluation.as_deref().map(read).transpose()?;
        if evaluation.as_ref().is_some_and(|evaluation: &Evaluation| !evaluation.deterministic) {
            return Err(Error::configuration("--evaluation: it was made with noise: evaluate with --deterministic"));
        }
        let assessment = self.assessment.as_deref().map(read).transpose()?;
        let clips = &file.experiment.clips;
        let builtin = !clips.is_empty() && clips.iter().all(|clip| clip.source.starts_with("builtin:"));
        let terms = self.terms.as_deref().or(builtin.then_some(BUILTIN_TERMS));
        let terms = terms.ok_or_else(|| {
            Error::configuration("--terms: its clips are not built in: say under which terms they may be used")
        })?;
        Ok(Card { command: command.into(), terms: terms.into(), evaluation, assessment })
    }
}

/// What a program printed as JSON.
fn read<T: DeserializeOwned>(path: &Path) -> Result<T> {
    let bytes = std::fs::read(path).map_err(Error::file("read", path))?;
    serde_json::from_slice(&bytes).map_err(Error::json(path.display().to_string()))
}

/// The description for people.
fn describe(file: &Exported) -> String {
    let Exported { spec, experiment, bytes } = file;
    let mut text = String::new();
    let mut line = |name: &str, value: String| {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{name:<18}{value}");
    };
    let latent = experiment.network.latent.size;
    line("low level", format!("a latent of {latent} numbers, {} bytes", bytes.len()));
    line("SHA-256", hex::encode(Sha256::digest(bytes)));
    line(
        "prior p(z | s)",
        match &spec.prior {
            Some(FittedPrior { nats: Some(nats), standard_nats: Some(standard), .. }) => {
                format!("−ln p {nats:.1} nats, N(0, I) {standard:.1} nats")
            }
            Some(_) => "learned with the encoder".into(),
            None => "none; `comic-learner prior` fits one".into(),
        },
    );
    let source = &spec.source;
    line("learned by", format!("{}, run {}, seed {}", source.program, source.run, source.seed));
    line("experience", format!("{} environment steps, {} updates", source.environment_steps, source.updates));
    let clips: Vec<_> = experiment.clips.iter().map(|clip| clip.source.as_str()).collect();
    line("clips", clips.join(", "));
    let Some(card) = &spec.card else {
        line("card", "none; --made-by writes one".into());
        return text;
    };
    line("made again by", card.command.clone());
    line("terms of the data", card.terms.clone());
    if let Some(evaluation) = &card.evaluation {
        text += &table(evaluation);
    }
    if let Some(assessment) = &card.assessment {
        text += &latents(assessment);
    }
    text
}

/// Without control characters: the file may come from anywhere, and a terminal obeys them.
fn printable(text: &str) -> String {
    text.chars().map(|sign| if sign.is_control() && sign != '\n' { '?' } else { sign }).collect()
}

/// A row for each source of latents, and the verdict.
fn latents(Assessment { rows, gate }: &Assessment) -> String {
    let mut text = format!(
        "\n{:<20}{:>10}{:>16}{:>12}{:>12}{:>10}\n",
        "random latents", "episodes", "upright", "median", "to the end", "walked"
    );
    for row in rows {
        let RandomLatents { latents, episodes, seconds_upright, median_seconds_upright, metres, .. } = row;
        let end = 100.0 * row.upright_to_the_end;
        text += &format!(
            "{latents:<20}{episodes:>10}{seconds_upright:>14.2} s{median_seconds_upright:>10.2} s{end:>10.0} %{metres:>8.2} m\n"
        );
    }
    let verdict = match gate {
        Some(Gate { passed: true }) => "pass",
        Some(Gate { passed: false }) => "FAIL",
        None => "no verdict, because the low level has no prior of the state",
    };
    text + &format!("gate: {verdict}\n")
}

/// A row for each clip.
fn table(evaluation: &Evaluation) -> String {
    let name = if evaluation.deterministic { "without noise" } else { "with noise" };
    let mut text = format!("\n{name:<20}{:>10}{:>20}{:>12}\n", "episodes", "normalised reward", "survived");
    for ClipEvaluation { clip, episodes, normalised_reward, fraction_survived } in
        evaluation.clips.iter().chain([&evaluation.overall])
    {
        text += &format!("{clip:<20}{episodes:>10}{normalised_reward:>20.3}{fraction_survived:>12.2}\n");
    }
    text
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        command: LowLevel,
    }

    fn command(arguments: &[&str]) -> LowLevel {
        Line::parse_from([&["low-level"], arguments].concat()).command
    }

    fn builtin() -> Exported {
        Exported::open_or_builtin(Path::new("builtin")).unwrap()
    }

    #[test]
    fn a_card_from_elsewhere_cannot_command_the_terminal() {
        assert_eq!(printable("walk\u{1b}[2J\r\nμ(s)\n"), "walk?[2J?\nμ(s)\n");
    }

    #[test]
    fn a_card_has_what_the_programs_measured_and_the_terms_of_the_built_in_clips() {
        let directory = tempfile::tempdir().unwrap();
        let file = |name: &str, text: &str| {
            let path = directory.path().join(name);
            std::fs::write(&path, text).unwrap();
            path.display().to_string()
        };
        let means = |clip: &str| {
            format!(
                r#"{{"clip":"{clip}","episodes":3,"diverged":0,"normalised_reward":0.625,"fraction_survived":0.75}}"#
            )
        };
        let report = |deterministic: bool| {
            let (clip, overall) = (means("CMU_007_01"), means("overall"));
            format!(r#"{{"deterministic":{deterministic},"noise":0.0,"seed":1,"clips":[{clip}],"overall":{overall}}}"#)
        };
        let row = r#"{"rows":[{"latents":"z = 0","episodes":64,"seconds_upright":1.5,"median_seconds_upright":1.25,
            "upright_to_the_end":0.25,"metres":2.0,"heading_std":null}],"gate":{"passed":false,"checks":[]}}"#;
        let out = directory.path().join("out.safetensors");
        let written = |evaluation: &str| {
            let evaluation = file("evaluation.json", evaluation);
            let (assessment, out) = (file("assessment.json", row), out.display().to_string());
            let arguments = ["--made-by", "make it", "--evaluation", &evaluation, "--assessment", &assessment];
            command(&[&["builtin", "--out", &out][..], &arguments].concat()).run()
        };
        written(&report(true)).unwrap();
        let found = Exported::open(&out).unwrap();
        let card = found.spec.card.clone().unwrap();
        assert_eq!((card.command.as_str(), card.terms.as_str()), ("make it", BUILTIN_TERMS));
        assert_eq!(
            (card.evaluation.unwrap().overall.normalised_reward, card.assessment.unwrap().rows[0].metres),
            (0.625, 2.0)
        );
        let text = describe(&found);
        for part in [
            "builtin:CMU_007_01",
            "make it",
            "mocap.cs.cmu.edu",
            "0.625",
            "z = 0",
            "1.50 s",
            "1.25 s",
            "25 %",
            "gate: FAIL",
        ] {
            assert!(text.contains(part), "no {part} in {text}");
        }
        // The rest is the low level as it was.
        assert_eq!(found.parameters().unwrap(), builtin().parameters().unwrap());
        assert!(written(&report(false)).unwrap_err().to_string().contains("--deterministic"));
        assert!(written("{}").unwrap_err().to_string().contains("evaluation.json"));
    }

    #[test]
    fn clips_of_ones_own_need_terms_and_another_part_is_refused() {
        let mut other = builtin();
        other.experiment.clips[0].source = "mine.h5".into();
        let refused = command(&["builtin"]).card("make it", &other).unwrap_err().to_string();
        assert!(refused.contains("--terms"), "{refused}");
        let given = command(&["builtin", "--out", "x", "--made-by", "make it", "--terms", "mine"]);
        assert_eq!(given.card("make it", &other).unwrap().terms, "mine");
        assert!(Line::try_parse_from(["low-level", "builtin", "--made-by", "make it"]).is_err());
        let absent = command(&["absent.safetensors"]).run().unwrap_err();
        assert!(comic_proto::chain(&absent).contains("absent.safetensors"), "{absent}");
    }
}
