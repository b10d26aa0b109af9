//! Finds circles among the modules of a crate: modules that need each other, directly or through others.
//!
//! Module A needs module B when a path in A leads to B. Every path counts: in `use`, in expressions, in types, in macros and
//! in attributes. Code under `#[cfg(test)]` does not count.
//!
//! A module and the modules inside it may need each other: the outer module declares the inner ones and re-exports their
//! items, and the inner ones use its types. No other circle is allowed.

mod source;
mod tree;

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, VecDeque};
use std::fmt;

use anyhow::Result;
use petgraph::algo::tarjan_scc;
use petgraph::graph::{DiGraph, NodeIndex};

use tree::{Edge, Id, Tree};

/// Modules that need each other.
pub struct Circle {
    /// All modules of the circle: a chain of paths leads from each of them to every other one.
    pub modules: Vec<String>,
    /// A shortest chain among them: the module, the one that it needs, and the place of the path, as `file:line`.
    pub chain: Vec<(String, String, String)>,
    /// Every place where one of the modules needs another.
    pub edges: Vec<(String, String, String)>,
}

impl fmt::Display for Circle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} modules need each other; the shortest circle:", self.modules.len())?;
        for (from, to, place) in &self.chain {
            writeln!(f, "  {from} -> {to} ({place})")?;
        }
        Ok(())
    }
}

/// The circles of the crate with this root; `files` has the texts of all its files by their paths.
///
/// # Errors
/// A file that is not Rust, or a module without a file.
pub fn circles(root: &str, files: &BTreeMap<&str, &str>) -> Result<Vec<Circle>> {
    let tree = Tree::read(root, files)?;
    let edges = tree.edges();
    let mut found = Vec::new();
    search(&tree, &edges, (0..tree.modules.len()).collect(), &mut found);
    Ok(found)
}

/// Looks for circles among `members`.
fn search(tree: &Tree, edges: &[Edge], members: Vec<Id>, found: &mut Vec<Circle>) {
    for component in components(edges, &members) {
        // A module that contains all others may be in a circle with them. The others may have circles without it.
        let outer = component.iter().find(|outer| component.iter().all(|id| id == *outer || tree.holds(**outer, *id)));
        match outer {
            Some(outer) => search(tree, edges, component.iter().copied().filter(|id| id != outer).collect(), found),
            None => found.push(circle(tree, edges, &component)),
        }
    }
}

/// The strongly connected components of at least two modules.
fn components(edges: &[Edge], members: &[Id]) -> Vec<Vec<Id>> {
    let mut graph = DiGraph::<Id, ()>::new();
    let nodes: BTreeMap<Id, NodeIndex> = members.iter().map(|id| (*id, graph.add_node(*id))).collect();
    for edge in edges {
        if let (Some(from), Some(to)) = (nodes.get(&edge.from), nodes.get(&edge.to)) {
            graph.add_edge(*from, *to, ());
        }
    }
    let components = tarjan_scc(&graph).into_iter().filter(|component| component.len() > 1);
    let mut components: Vec<Vec<Id>> =
        components.map(|component| component.into_iter().map(|node| graph[node]).collect()).collect();
    for component in &mut components {
        component.sort_unstable();
    }
    components.sort();
    components
}

fn circle(tree: &Tree, edges: &[Edge], component: &[Id]) -> Circle {
    let inside: Vec<&Edge> =
        edges.iter().filter(|edge| component.contains(&edge.from) && component.contains(&edge.to)).collect();
    // The chain contains an edge between two modules with different outermost modules. So no module contains all the others.
    let outermost = |id: Id| component.iter().copied().find(|outer| *outer == id || tree.holds(*outer, id));
    let crossing = inside.iter().filter(|edge| outermost(edge.from) != outermost(edge.to));
    let chain = crossing
        .filter_map(|edge| {
            let mut chain = shortest(&inside, edge.to, edge.from)?;
            chain.insert(0, edge);
            Some(chain)
        })
        .min_by_key(Vec::len);
    let say =
        |edge: &&Edge| (tree.modules[edge.from].name.clone(), tree.modules[edge.to].name.clone(), tree.place(edge));
    Circle {
        modules: component.iter().map(|id| tree.modules[*id].name.clone()).collect(),
        chain: chain.unwrap_or_default().iter().map(say).collect(),
        edges: inside.iter().map(say).collect(),
    }
}

/// A shortest chain of edges.
fn shortest<'a>(edges: &[&'a Edge], from: Id, to: Id) -> Option<Vec<&'a Edge>> {
    let mut chains = BTreeMap::from([(from, Vec::new())]);
    let mut waiting = VecDeque::from([from]);
    while let Some(at) = waiting.pop_front() {
        let chain = chains.get(&at)?.clone();
        if at == to {
            return Some(chain);
        }
        for edge in edges.iter().filter(|edge| edge.from == at) {
            if let Entry::Vacant(unseen) = chains.entry(edge.to) {
                unseen.insert([chain.as_slice(), &[*edge]].concat());
                waiting.push_back(edge.to);
            }
        }
    }
    None
}

#[cfg(test)]
mod tests;
