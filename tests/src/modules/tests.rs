use super::*;

/// The names of the modules of every circle; the first file is the root.
fn circles_of(files: &[(&str, &str)]) -> Vec<Vec<String>> {
    let found = circles(files[0].0, &files.iter().copied().collect()).unwrap();
    found.into_iter().map(|circle| circle.modules).collect()
}

fn one_circle(names: &[&str]) -> Vec<Vec<String>> {
    vec![names.iter().map(|name| format!("crate::{name}")).collect()]
}

#[test]
fn two_modules_that_import_each_other_are_a_circle() {
    let files = [
        ("src/lib.rs", "mod a; mod b;"),
        ("src/a.rs", "use crate::b::B;\n\npub struct A(B);"),
        ("src/b.rs", "pub struct B;\ntype Other = super::a::A;"),
    ];
    assert_eq!(circles_of(&files), one_circle(&["a", "b"]));
    let found = circles("src/lib.rs", &files.into_iter().collect()).unwrap();
    assert_eq!(
        found[0].to_string(),
        "2 modules need each other; the shortest circle:\n  crate::a -> crate::b (src/a.rs:1)\n  \
         crate::b -> crate::a (src/b.rs:2)\n"
    );
}

#[test]
fn a_chain_of_modules_is_no_circle() {
    let files = [
        ("src/lib.rs", "mod a; mod b; mod c; pub use c::C;"),
        ("src/a.rs", "use crate::b::B; use crate::c::C;"),
        ("src/b.rs", "use crate::c; pub struct B(c::C);"),
        ("src/c.rs", "pub struct C;"),
    ];
    assert!(circles_of(&files).is_empty());
}

#[test]
fn a_module_and_its_children_may_need_each_other() {
    let files = [
        ("src/lib.rs", "mod service;"),
        ("src/service/mod.rs", "mod roster; mod calls; pub use roster::Roster; pub struct Shared(calls::Calls);"),
        ("src/service/roster.rs", "use super::Shared; pub struct Roster;"),
        ("src/service/calls.rs", "use crate::service::Shared; pub struct Calls;"),
    ];
    assert!(circles_of(&files).is_empty());
}

#[test]
fn children_that_need_each_other_are_a_circle_though_their_parent_needs_them() {
    let files = [
        ("src/lib.rs", "mod service;"),
        ("src/service.rs", "mod roster; mod calls; pub struct Shared(calls::Calls, roster::Roster);"),
        ("src/service/roster.rs", "use super::{Shared, calls::Calls}; pub struct Roster;"),
        ("src/service/calls.rs", "use super::{Shared, roster::Roster}; pub struct Calls;"),
    ];
    assert_eq!(circles_of(&files), one_circle(&["service::roster", "service::calls"]));
}

#[test]
fn a_circle_of_three_through_a_folder_is_found() {
    let files = [
        ("src/lib.rs", "mod service; mod observe;"),
        ("src/service.rs", "mod calls; pub struct Shared(calls::Calls);"),
        ("src/service/calls.rs", "pub struct Calls(crate::observe::Metrics);"),
        ("src/observe.rs", "pub struct Metrics(crate::service::Shared);"),
    ];
    assert_eq!(circles_of(&files), one_circle(&["service", "observe"]));
}

#[test]
fn folders_that_need_each_other_are_a_circle_though_their_files_are_not() {
    let files = [
        ("src/lib.rs", "mod render; mod evaluate;"),
        ("src/render.rs", "mod scene; pub mod film;"),
        ("src/render/scene.rs", "use crate::evaluate::rollout::Start;"),
        ("src/render/film.rs", "pub struct Film;"),
        ("src/evaluate.rs", "mod command; pub mod rollout;"),
        ("src/evaluate/command.rs", "use crate::render::film::Film;"),
        ("src/evaluate/rollout.rs", "pub struct Start;"),
    ];
    assert_eq!(circles_of(&files), one_circle(&["render", "evaluate"]));
    let one_way = [&files[..5], &[("src/evaluate/command.rs", ""), files[6]]].concat();
    assert!(circles_of(&one_way).is_empty());
}

#[test]
fn a_circle_through_a_folder_and_a_file_is_found() {
    let files = [
        ("src/lib.rs", "mod outer;"),
        ("src/outer.rs", "mod a; mod folder;"),
        ("src/outer/a.rs", "use super::folder::first::First; pub struct A;"),
        ("src/outer/folder.rs", "pub mod first; mod second;"),
        ("src/outer/folder/first.rs", "pub struct First;"),
        ("src/outer/folder/second.rs", "use crate::outer::a::A;"),
    ];
    assert_eq!(circles_of(&files), one_circle(&["outer::a", "outer::folder"]));
}

#[test]
fn what_the_root_exports_again_leads_to_the_module_that_has_it() {
    let by_name = "mod a; mod b; mod unused; pub use a::A; pub use b::B;";
    let by_glob = "mod a; mod b; mod unused; pub use unused::*; pub use a::*; pub use b::*;";
    for root in [by_name, by_glob] {
        let circular = [
            ("src/lib.rs", root),
            ("src/a.rs", "pub struct A(crate::B);"),
            ("src/b.rs", "pub struct B; type Other = crate::A;"),
            ("src/unused.rs", ""),
        ];
        assert_eq!(circles_of(&circular), one_circle(&["a", "b"]));
        let straight = [circular[0], circular[1], ("src/b.rs", "pub struct B;"), circular[3]];
        assert!(circles_of(&straight).is_empty());
    }
}

#[test]
fn an_item_of_the_root_is_the_roots() {
    let files = [
        ("src/lib.rs", "mod a; mod b; pub struct Error; pub fn run() { a::run(); b::run() }"),
        ("src/a.rs", "use crate::{Error, b}; pub fn run() { b::run() }"),
        ("src/b.rs", "use super::Error; pub fn run() {}"),
    ];
    assert!(circles_of(&files).is_empty());
}

/// Each source makes module `a` need module `b`.
#[test]
fn paths_count_wherever_they_stand() {
    for path in [
        "fn f() { vec![crate::b::B]; }",
        "macro_rules! m { () => { $crate::b::B } }",
        "fn f() -> Option<super::b::B> { None }",
        "fn f() { let x: Vec<crate::b::B> = Vec::new(); }",
        "impl From<crate::b::B> for A {}",
        "impl A { fn f(&self) { self.x.map(super::b::f) } }",
        "use crate::b; fn f() { b::f() }",
        "fn f() { use crate::b as other; other::f() }",
        "use super::{unused, b::{self as other, B}};",
        "use crate::b::*;",
        "#[derive(Deserialize)] struct S { #[serde(default = \"crate::b::f\")] field: u8 }",
        "#[error(fmt = crate::b::f)] struct S;",
        "mod inner { use super::super::b::B; } pub use inner::B;",
        "#[cfg(any(test, unix))] fn f() { crate::b::f() }",
        "#[cfg(test)] mod tests { } fn f() { crate::b::f() }",
    ] {
        let files = [
            ("src/lib.rs", "mod a; mod b; mod unused;"),
            ("src/a.rs", path),
            ("src/b.rs", "pub struct B; use crate::a;"),
            ("src/unused.rs", ""),
        ];
        let found = circles_of(&files);
        assert!(found.len() == 1 && found[0].contains(&"crate::a".to_owned()), "{path}: {found:?}");
    }
}

#[test]
fn text_and_tests_and_visibility_do_not_count() {
    for path in [
        "// use crate::b::B;",
        "/// See [`crate::b::B`].\nfn f() {}",
        "#[doc = \"crate::b\"] fn f() {}",
        "fn f() -> &'static str { \"crate::b::B\" }",
        "#[cfg(test)] mod tests { use crate::b::B; }",
        "#[cfg(test)]\npub(crate) mod tests { use crate::b::B; }",
        "#[cfg(test)] use crate::{b::B, unused};",
        "#[cfg(test)] fn f() { crate::b::f() }",
        "pub(in crate::b) fn f() {}",
        "fn f() { other.b::<u8>(); ::b::f(); }",
    ] {
        let files = [
            ("src/lib.rs", "mod a; mod b; mod unused;"),
            ("src/a.rs", path),
            ("src/b.rs", "pub struct B; use crate::a;"),
            ("src/unused.rs", ""),
        ];
        assert!(circles_of(&files).is_empty(), "{path}");
    }
}

#[test]
fn modules_lie_where_the_compiler_looks_for_them() {
    let files = [
        ("a/src/main.rs", "#[path = \"../other/place.rs\"] mod placed; mod inline { pub mod deep; } mod folder;"),
        ("a/other/place.rs", "use crate::inline::deep;"),
        ("a/src/inline/deep.rs", "use crate::folder::leaf;"),
        ("a/src/folder/mod.rs", "pub mod leaf;"),
        ("a/src/folder/leaf.rs", "use crate::placed;"),
    ];
    assert_eq!(circles_of(&files), one_circle(&["placed", "inline", "folder"]));
}

#[test]
fn a_module_without_a_file_is_an_error() {
    let error = circles("src/lib.rs", &[("src/lib.rs", "mod a;")].into_iter().collect()).err().unwrap();
    assert_eq!(error.to_string(), "module crate::a: no file at [\"src/a.rs\", \"src/a/mod.rs\"]");
}
