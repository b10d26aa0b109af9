//! The pages for people: their links lead somewhere.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use comic_tests::repository::root;

/// The pages of the repository's root, of `docs/`, of `docs/results/` and of `deploy/`.
fn pages() -> Result<Vec<PathBuf>> {
    let mut pages = Vec::new();
    for folder in ["", "docs", "docs/results", "deploy"] {
        let folder = root().join(folder);
        for entry in fs::read_dir(&folder).with_context(|| format!("cannot list {}", folder.display()))? {
            let path = entry?.path();
            if path.extension().is_some_and(|extension| extension == "md") {
                pages.push(path);
            }
        }
    }
    Ok(pages)
}

/// The page's lines outside of code blocks.
fn prose(page: &Path) -> Result<Vec<String>> {
    let text = fs::read_to_string(page).with_context(|| format!("cannot read {}", page.display()))?;
    let mut code = false;
    let mut lines = Vec::new();
    for line in text.lines() {
        if line.starts_with("```") {
            code = !code;
        } else if !code {
            lines.push(line.to_owned());
        }
    }
    Ok(lines)
}

/// What the page's links and pictures lead to, without those that begin with a scheme such as `https:`.
fn targets(page: &Path) -> Result<Vec<String>> {
    let mut targets = Vec::new();
    for line in prose(page)? {
        let parts = line.split("](").skip(1).filter_map(|rest| rest.split(')').next());
        targets.extend(parts.filter(|target| !target.contains(':')).map(str::to_owned));
    }
    Ok(targets)
}

/// The anchors of the page's headings: lower case, hyphens for spaces, no punctuation.
fn anchors(page: &Path) -> Result<BTreeSet<String>> {
    let lines = prose(page)?;
    let headings = lines.iter().filter(|line| line.starts_with('#')).map(|line| line.trim_start_matches('#').trim());
    let anchor = |heading: &str| {
        let kept = heading.chars().filter(|letter| letter.is_alphanumeric() || " -_".contains(*letter));
        kept.collect::<String>().to_lowercase().replace(' ', "-")
    };
    Ok(headings.map(anchor).collect())
}

#[test]
fn every_link_leads_to_a_file_and_an_anchor_that_exist() -> Result<()> {
    let mut broken = Vec::new();
    for page in pages()? {
        let folder = page.parent().context("a page has a folder")?;
        for target in targets(&page)? {
            let (path, anchor) = target.split_once('#').unwrap_or((&target, ""));
            let file = if path.is_empty() { page.clone() } else { folder.join(path) };
            let exists = file.exists() && (anchor.is_empty() || anchors(&file)?.contains(anchor));
            if !exists {
                broken.push(format!("{}: {target}", page.display()));
            }
        }
    }
    ensure!(broken.is_empty(), "broken links: {broken:#?}");
    Ok(())
}

/// A link out of `docs/` would work on a repository's host and be broken in the book.
#[test]
fn links_of_the_books_pages_stay_in_the_book() -> Result<()> {
    let docs = root().join("docs");
    let canonical = docs.canonicalize()?;
    for page in pages()?.iter().filter(|page| page.starts_with(&docs)) {
        let folder = page.parent().context("a page has a folder")?;
        let leaves = |target: &String| {
            let file = folder.join(target.split('#').next().unwrap_or_default());
            // A link that leads nowhere is another test's.
            file.canonicalize().is_ok_and(|file| !file.starts_with(&canonical))
        };
        let outside: Vec<_> = targets(page)?.into_iter().filter(leaves).collect();
        ensure!(outside.is_empty(), "{}: {outside:?}", page.display());
    }
    Ok(())
}

#[test]
fn the_summary_of_the_book_has_every_page() -> Result<()> {
    let docs = root().join("docs");
    let listed = targets(&docs.join("SUMMARY.md"))?;
    for page in pages()?.iter().filter(|page| page.starts_with(&docs)) {
        let name = page.strip_prefix(&docs)?.to_string_lossy();
        ensure!(name == "SUMMARY.md" || listed.iter().any(|target| *target == name), "docs/SUMMARY.md lacks {name}");
    }
    Ok(())
}

#[test]
fn the_readme_is_short() -> Result<()> {
    let lines = fs::read_to_string(root().join("README.md"))?.lines().count();
    ensure!(lines <= 150, "README.md has {lines} lines: a page of docs/ has room");
    Ok(())
}
