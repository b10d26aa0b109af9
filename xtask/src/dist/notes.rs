//! The notes of a release: its section of the changelog.

use anyhow::{Context, Result, ensure};

/// What the section of `version` says in a changelog in the format of Keep a Changelog, without its heading.
///
/// # Errors
/// A version without a section, or with an empty one.
pub(super) fn section(changelog: &str, version: &str) -> Result<String> {
    let mut lines = changelog.lines().skip_while(|line| version_of(line) != Some(version));
    lines.next().with_context(|| {
        format!(
            "CHANGELOG.md has no section for {version}: give the heading `## [Unreleased]` the name `## {version} - DATE`, or \
             correct the version in Cargo.toml"
        )
    })?;
    let section: Vec<_> = lines.take_while(|line| !line.starts_with("## ")).collect();
    let section = section.join("\n").trim().to_owned();
    ensure!(!section.is_empty(), "the section for {version} in CHANGELOG.md is empty: say what has changed");
    Ok(section + "\n")
}

/// The version that a line such as `## 1.2.0 - 2026-01-31` or `## [1.2.0] - 2026-01-31` is the heading of.
fn version_of(line: &str) -> Option<&str> {
    let name = line.strip_prefix("## ")?.split_whitespace().next()?;
    Some(name.trim_matches(['[', ']']))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CHANGELOG: &str = "# Changelog\n\n## [Unreleased]\n\nnew\n\n## 1.10.0 - 2026-02-01\n\n### Added\n- ten\n\n\
                             ## [1.1.0] - 2026-01-01\n- one\n## 1.0.0\n\n";

    #[test]
    fn the_notes_are_the_section_of_the_version_with_its_subheadings() {
        assert_eq!(section(CHANGELOG, "1.10.0").unwrap(), "### Added\n- ten\n");
        assert_eq!(section(CHANGELOG, "1.1.0").unwrap(), "- one\n");
    }

    #[test]
    fn a_version_without_a_section_is_refused_with_the_remedy() {
        let error = section(CHANGELOG, "1.1").unwrap_err().to_string();
        assert!(error.contains("no section for 1.1:") && error.contains("## 1.1 - DATE"), "{error}");
    }

    #[test]
    fn an_empty_section_is_refused() {
        assert!(section(CHANGELOG, "1.0.0").unwrap_err().to_string().contains("is empty"));
    }
}
