//! Finds circles among the modules of a crate: modules that need each other, directly or through others.
//!
//! Module A needs module B when a path in A leads to B. Every path counts: in `use`, in expressions, in types, in macros and
//! in attributes. Code under `#[cfg(test)]` does not count.
//!
//! A module stands for itself and all modules inside it: a folder is one module to its siblings. Inside, a module and the
//! modules in it may need each other: the outer module declares the inner ones and re-exports their items, and the inner
//! ones use its types. No other circle is allowed.

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
    /// Every place where one of the modules, or a module inside it, needs another.
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
    Ok(components(&edges, tree.modules.len()).iter().map(|component| circle(&tree, &edges, component)).collect())
}

/// The strongly connected components of at least two modules.
fn components(edges: &[Edge], modules: usize) -> Vec<Vec<Id>> {
    let mut graph = DiGraph::<(), ()>::new();
    let nodes: Vec<NodeIndex> = (0..modules).map(|_| graph.add_node(())).collect();
    for edge in edges {
        graph.add_edge(nodes[edge.from], nodes[edge.to], ());
    }
    let components = tarjan_scc(&graph).into_iter().filter(|component| component.len() > 1);
    let mut components: Vec<Vec<Id>> =
        components.map(|component| component.into_iter().map(NodeIndex::index).collect()).collect();
    for component in &mut components {
        component.sort_unstable();
    }
    components.sort();
    components
}

fn circle(tree: &Tree, edges: &[Edge], component: &[Id]) -> Circle {
    let inside: Vec<&Edge> =
        edges.iter().filter(|edge| component.contains(&edge.from) && component.contains(&edge.to)).collect();
    let chains = inside.iter().filter_map(|edge| {
        let mut chain = shortest(&inside, edge.to, edge.from)?;
        chain.insert(0, edge);
        Some(chain)
    });
    let name = |id: Id| tree.modules[id].name.clone();
    let say = |edge: &&Edge| (name(edge.from), name(edge.to), edge.place.clone());
    Circle {
        modules: component.iter().copied().map(name).collect(),
        chain: chains.min_by_key(Vec::len).unwrap_or_default().iter().map(say).collect(),
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
