//! The modules of one crate, and which module each path leads to.

use std::collections::BTreeMap;

use anyhow::{Result, anyhow};
use proc_macro2::TokenStream;

use super::source::{self, Contents};

/// Imports of imports are followed this far.
const MOST_STEPS: usize = 16;

/// A module, by its place in [`Tree::modules`].
pub(super) type Id = usize;

/// The root is module 0.
pub(super) struct Tree {
    pub(super) modules: Vec<Module>,
}

pub(super) struct Module {
    parent: Option<Id>,
    children: BTreeMap<String, Id>,
    /// Its path from the root: `crate::service::roster`.
    pub(super) name: String,
    pub(super) file: String,
    contents: Contents,
}

/// A module, or one inside it, uses something of another one, or of a module inside that one. Both have the same parent.
pub(super) struct Edge {
    pub(super) from: Id,
    pub(super) to: Id,
    /// Where, as `path:line`.
    pub(super) place: String,
}

impl Tree {
    /// `root` is the path of a crate's root, for instance `learner/src/lib.rs`; `files` has all texts by their paths.
    pub(super) fn read(root: &str, files: &BTreeMap<&str, &str>) -> Result<Self> {
        let mut tree = Self { modules: Vec::new() };
        let text = files.get(root).ok_or_else(|| anyhow!("no such file: {root}"))?;
        let directory = root.rsplit_once('/').map_or("", |(directory, _)| directory);
        tree.add(None, "crate".into(), root, directory, tokens(root, text)?, files)?;
        Ok(tree)
    }

    /// `directory` holds the files of the module's children.
    fn add(
        &mut self,
        parent: Option<Id>,
        name: String,
        file: &str,
        directory: &str,
        text: TokenStream,
        files: &BTreeMap<&str, &str>,
    ) -> Result<Id> {
        let mut contents = source::read(text);
        let declared = std::mem::take(&mut contents.declared);
        let id = self.modules.len();
        self.modules.push(Module { parent, children: BTreeMap::new(), name, file: file.into(), contents });
        for child in declared {
            let name = format!("{}::{}", self.modules[id].name, child.name);
            let inside = format!("{directory}/{}", child.name);
            let added = if let Some(body) = child.body {
                self.add(Some(id), name, file, &inside, body, files)?
            } else {
                let beside = file.rsplit_once('/').map_or("", |(beside, _)| beside);
                let places = match child.file {
                    Some(place) => vec![normal(&format!("{beside}/{place}"))],
                    None => vec![format!("{inside}.rs"), format!("{inside}/mod.rs")],
                };
                let found = places.iter().find_map(|place| files.get_key_value(place.as_str()));
                let (&file, text) = found.ok_or_else(|| anyhow!("module {name}: no file at {places:?}"))?;
                self.add(Some(id), name, file, &inside, tokens(file, text)?, files)?
            };
            self.modules[id].children.insert(child.name, added);
        }
        Ok(id)
    }

    /// Whether `ancestor` contains `module`, at any depth.
    pub(super) fn holds(&self, ancestor: Id, module: Id) -> bool {
        module != ancestor && self.chain(module).contains(&ancestor)
    }

    /// The root, and so on down to the module itself.
    fn chain(&self, module: Id) -> Vec<Id> {
        let mut chain: Vec<Id> = std::iter::successors(Some(module), |at| self.modules[*at].parent).collect();
        chain.reverse();
        chain
    }

    /// Every edge, with the first line of each module that causes it.
    pub(super) fn edges(&self) -> Vec<Edge> {
        let mut first: BTreeMap<(Id, Id), usize> = BTreeMap::new();
        for (from, module) in self.modules.iter().enumerate() {
            let imports = module.contents.imports.iter().map(|import| &import.path);
            for path in imports.chain(&module.contents.paths) {
                if let Some(to) = self.resolve(from, from, &path.segments, 0).filter(|to| *to != from) {
                    let line = first.entry((from, to)).or_insert(path.line);
                    *line = path.line.min(*line);
                }
            }
        }
        let edge = |((user, used), line): ((Id, Id), usize)| {
            // If one module is inside the other, there is no edge.
            let mut levels = self.chain(user).into_iter().zip(self.chain(used));
            let (from, to) = levels.find(|(from, to)| from != to)?;
            Some(Edge { from, to, place: format!("{}:{line}", self.modules[user].file) })
        };
        first.into_iter().filter_map(edge).collect()
    }

    /// The module that a path leads to. `user` names it; `at` is the module in which it is written.
    fn resolve(&self, user: Id, at: Id, segments: &[String], steps: usize) -> Option<Id> {
        let (first, rest) = segments.split_first()?;
        match first.as_str() {
            _ if steps > MOST_STEPS => None,
            "crate" => self.descend(user, 0, rest, steps),
            "self" => self.descend(user, at, rest, steps),
            "super" => self.ascend(user, self.modules[at].parent?, rest, steps),
            _ => match self.modules[at].children.get(first) {
                Some(child) => self.descend(user, *child, rest, steps),
                None => self.follow(user, at, first, rest, steps),
            },
        }
    }

    fn ascend(&self, user: Id, at: Id, segments: &[String], steps: usize) -> Option<Id> {
        match segments.split_first() {
            Some((first, rest)) if first == "super" => self.ascend(user, self.modules[at].parent?, rest, steps),
            _ => self.descend(user, at, segments, steps),
        }
    }

    /// A re-export in a module that encloses the user leads to the module with the item. A re-export in any other module
    /// leads only to that module, since the user depends on it.
    fn descend(&self, user: Id, at: Id, segments: &[String], steps: usize) -> Option<Id> {
        let Some((first, rest)) = segments.split_first() else { return Some(at) };
        if let Some(child) = self.modules[at].children.get(first) {
            return self.descend(user, *child, rest, steps);
        }
        let exported = self.holds(at, user).then(|| self.follow(user, at, first, rest, steps)).flatten();
        Some(exported.unwrap_or(at))
    }

    /// Follows the import that brings `name` into the scope of `at`.
    fn follow(&self, user: Id, at: Id, name: &str, rest: &[String], steps: usize) -> Option<Id> {
        let contents = &self.modules[at].contents;
        if contents.defined.contains(name) {
            return None;
        }
        let named = contents.imports.iter().find(|import| import.name.as_deref() == Some(name));
        if let Some(import) = named {
            let path = [&import.path.segments, rest].concat();
            return self.resolve(user, at, &path, steps + 1);
        }
        let globs = contents.imports.iter().filter(|import| import.name.is_none());
        globs.filter_map(|import| self.resolve(user, at, &import.path.segments, steps + 1)).find(|found| {
            let Module { children, contents, .. } = &self.modules[*found];
            let imported = || contents.imports.iter().any(|import| import.name.as_deref() == Some(name));
            children.contains_key(name) || contents.defined.contains(name) || imported()
        })
    }
}

fn tokens(file: &str, text: &str) -> Result<TokenStream> {
    text.parse().map_err(|error| anyhow!("{file}: {error}"))
}

/// Without `..`.
fn normal(path: &str) -> String {
    let mut parts: Vec<&str> = Vec::new();
    for part in path.split('/') {
        match part {
            ".." => drop(parts.pop()),
            _ => parts.push(part),
        }
    }
    parts.join("/")
}
