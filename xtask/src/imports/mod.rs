//! Circles among the modules of a crate: what cannot be understood, tested or replaced one after the other.
//!
//! At every level a module's own file and its children are told apart. One of them uses another where it imports from it,
//! or names a path into it, anywhere below. A re-export leads to what it stands for, and is no use by itself; tests may use
//! what they like. A child that uses an item of its parent's file, whose file uses the child, is a circle too.

mod modules;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Result, ensure};

use self::modules::{Modules, Use};
use crate::workspace::Workspace;

/// The crates that must have none, each by the file of its root.
const ROOTS: [&str; 2] = ["protocol/src/lib.rs", "mcu-bridge/src/lib.rs"];

/// Fails where there is a circle in one of the crates, and says how it closes.
pub(crate) fn check(workspace: &Workspace) -> Result<()> {
    let mut found = String::new();
    for root in ROOTS {
        found.push_str(&circles(&workspace.root, root)?);
    }
    ensure!(found.is_empty(), "modules that import each other:\n{found}");
    println!("no circle in {}", ROOTS.join(", "));
    Ok(())
}

/// Neighbours at one level: who uses whom, and the first place that says so.
type Level<'uses> = BTreeMap<usize, BTreeMap<usize, &'uses Use>>;

/// Some lines for people about every circle of a crate.
fn circles(workspace: &Path, root: &str) -> Result<String> {
    let modules = Modules::read(&workspace.join(root))?;
    let uses = modules.uses();
    let mut levels: BTreeMap<usize, Level<'_>> = BTreeMap::new();
    for one in &uses {
        let (level, from, to) = modules.neighbours(one.from, one.to);
        levels.entry(level).or_default().entry(from).or_default().entry(to).or_insert(one);
    }
    let mut text = String::new();
    for (at, level) in &levels {
        for group in groups(level) {
            describe(&modules, workspace, root, *at, level, &group, &mut text)?;
        }
    }
    Ok(text)
}

impl Modules {
    /// The closest module that holds both, and its children that they are in, or itself where it is one of them.
    fn neighbours(&self, a: usize, b: usize) -> (usize, usize, usize) {
        let (above_a, above_b) = (self.line(a), self.line(b));
        let common = above_a.iter().zip(&above_b).take_while(|(a, b)| a == b).count();
        let level = above_a[common - 1];
        let neighbour = |line: &[usize]| line.get(common).copied().unwrap_or(level);
        (level, neighbour(&above_a), neighbour(&above_b))
    }

    /// The modules from the root down to this one.
    fn line(&self, at: usize) -> Vec<usize> {
        let above = self.0[at].parent;
        let mut line = above.map(|above| self.line(above)).unwrap_or_default();
        line.push(at);
        line
    }
}

/// The neighbours that can all be reached from each other.
fn groups(level: &Level<'_>) -> BTreeSet<BTreeSet<usize>> {
    let reached: BTreeMap<usize, BTreeSet<usize>> =
        level.keys().map(|from| (*from, way(level, *from, None).into_iter().collect())).collect();
    let mut groups = BTreeSet::new();
    for (one, ahead) in &reached {
        let back = |other: &&usize| reached.get(other).is_some_and(|ahead| ahead.contains(one));
        let group: BTreeSet<usize> = ahead.iter().filter(back).copied().collect();
        if group.len() > 1 {
            groups.insert(group);
        }
    }
    groups
}

/// The shortest way to a neighbour, the start left out; without a destination, all that can be reached.
fn way(level: &Level<'_>, start: usize, end: Option<usize>) -> Vec<usize> {
    let mut before = BTreeMap::new();
    let mut open = VecDeque::from([start]);
    while let Some(at) = open.pop_front() {
        for next in level.get(&at).into_iter().flat_map(BTreeMap::keys) {
            if !before.contains_key(next) {
                before.insert(*next, at);
                open.push_back(*next);
            }
        }
    }
    let Some(end) = end else { return before.into_keys().collect() };
    let mut way = vec![end];
    while let Some(at) = before.get(&way[way.len() - 1]).filter(|at| **at != start) {
        way.push(*at);
    }
    way.reverse();
    way
}

/// Names a group, its shortest circle, and each use inside it.
fn describe(
    modules: &Modules,
    workspace: &Path,
    root: &str,
    at: usize,
    level: &Level<'_>,
    group: &BTreeSet<usize>,
    text: &mut String,
) -> Result<()> {
    let name = |module: usize| match modules.0[module].path.last() {
        Some(name) if module != at => name.as_str(),
        _ => "its own file",
    };
    let inside: Level<'_> = level
        .iter()
        .filter(|(from, _)| group.contains(from))
        .map(|(from, to)| {
            (*from, to.iter().filter(|(to, _)| group.contains(to)).map(|(a, b)| (*a, *b)).collect())
        })
        .collect();
    let shortest = group.iter().map(|start| way(&inside, *start, Some(*start))).min_by_key(Vec::len);
    let shortest = shortest.unwrap_or_default();
    let circle = shortest.last().into_iter().chain(&shortest).map(|one| name(*one)).collect::<Vec<_>>();
    let names: Vec<_> = group.iter().map(|one| name(*one)).collect();
    writeln!(text, "{root}, {}: {}", modules.0[at].path.join("::"), names.join(", "))?;
    writeln!(text, "  {}", circle.join(" -> "))?;
    for (from, uses) in &inside {
        for (to, one) in uses {
            let file = &modules.0[one.from].file;
            let file = file.strip_prefix(workspace).unwrap_or(file).display();
            writeln!(text, "    {} -> {}: {file}:{} {}", name(*from), name(*to), one.line, one.path)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// What is found in a crate of these files.
    fn found(files: &[(&str, &str)]) -> String {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        circles(folder.path(), "lib.rs").unwrap()
    }

    #[test]
    fn modules_that_import_each_other_are_a_circle() {
        let found = found(&[
            ("lib.rs", "mod a;\nmod b;\nmod c;"),
            ("a.rs", "use crate::b::B;\npub struct A;"),
            ("b.rs", "\nuse super::c;\npub struct B;"),
            ("c.rs", "pub fn c() { crate::a::A; }"),
        ]);
        assert_eq!(
            found,
            "lib.rs, crate: a, b, c\n  a -> b -> c -> a\n    a -> b: a.rs:1 crate::b::B\n    \
             b -> c: b.rs:2 super::c\n    c -> a: c.rs:1 crate::a::A\n"
        );
    }

    #[test]
    fn a_way_without_return_is_none() {
        let files = [
            ("lib.rs", "pub mod a;\nmod b;\nmod c;\nuse a::A;"),
            ("a.rs", "use crate::{b::B, c};\npub struct A(B, c::C);"),
            ("b.rs", "use super::c::C;\npub struct B(C);"),
            ("c.rs", "pub struct C;"),
        ];
        assert_eq!(found(&files), "");
    }

    #[test]
    fn a_parent_and_its_child_are_a_circle_where_each_uses_the_other() {
        let parent = "mod child;\nuse child::Child;\npub struct Parent(Child);";
        let child = "use super::Parent;\npub struct Child;";
        let found =
            found(&[("lib.rs", "mod parent;"), ("parent/mod.rs", parent), ("parent/child.rs", child)]);
        assert!(found.contains("crate::parent: its own file, child\n"), "{found}");
        assert!(found.contains("child -> its own file: parent/child.rs:1 super::Parent"), "{found}");
    }

    #[test]
    fn a_reexport_is_a_name_and_no_use_by_itself() {
        let files =
            |parent| [("lib.rs", parent), ("a.rs", "pub struct A;"), ("b.rs", "use super::{A, MAX};")];
        let plain = "mod a;\nmod b;\npub use a::A;\npub use b::*;\npub const MAX: u8 = 1;";
        assert_eq!(found(&files(plain)), "", "b uses a, by the name that its parent has for it");
        let used = "mod a;\nmod b;\npub use a::A;\npub use b::B;\npub const MAX: u8 = 1;\nfn f(_: B) {}";
        assert!(found(&files(used)).contains("its own file -> b: lib.rs:6 B"), "{}", found(&files(used)));
    }

    #[test]
    fn a_reexport_of_all_leads_to_what_is_named() {
        let files = [
            ("lib.rs", "mod a;\nmod b;\npub use a::*;\nuse b::B;\nfn f(_: B) {}"),
            ("a.rs", "pub struct A;"),
            ("b.rs", "use crate::A;\npub struct B(A);"),
        ];
        assert_eq!(found(&files), "");
    }

    #[test]
    fn folders_are_a_circle_even_if_their_files_are_none() {
        let found = found(&[
            ("lib.rs", "mod a { pub mod x; pub mod y; }\nmod b;"),
            ("a/x.rs", "use crate::b::B;"),
            ("a/y.rs", "pub struct Y;"),
            ("b.rs", "use crate::a::y::Y;\npub struct B;"),
        ]);
        assert!(found.starts_with("lib.rs, crate: a, b\n"), "{found}");
    }

    #[test]
    fn paths_in_macros_count_and_those_of_tests_do_not() {
        let files = |b| [("lib.rs", "mod a;\nmod b;"), ("a.rs", "use super::b;"), ("b.rs", b)];
        assert!(found(&files("fn f() { assert!(x == crate::a::A); }")).contains("b -> a: b.rs:1"));
        assert_eq!(found(&files("#[cfg(test)]\nmod tests {\n    use crate::a;\n}")), "");
        assert_eq!(found(&files("#[cfg(test)]\nuse crate::a;\npub(super) fn f() { let a = 1; a }")), "");
    }
}
