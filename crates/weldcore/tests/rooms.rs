//! Who uses whom in the core: no two files need each other, and no room one that stands above it; and no two types have
//! one name.
//!
//! Read from the paths in the source (`crate::…`, `super::…`, `mod …`), as far as they name files; tests may look anywhere.

#![allow(clippy::unwrap_used, clippy::panic)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// From the ground up: a room may use those of the rows before its own.
const ROOMS: [&[&str]; 6] =
    [&["error", "ground"], &["fringes", "surfaces"], &["scanner", "clouds"], &["weld", "simulate"], &["python"], &[""]];

/// Module paths, `clouds::kdtree::tree`; the crate's root is "".
type Files = BTreeMap<String, PathBuf>;
type Uses = BTreeMap<String, BTreeSet<String>>;

fn files(folder: &Path, module: &str, found: &mut Files) {
    let Ok(entries) = fs::read_dir(folder) else { panic!("no folder {}", folder.display()) };
    for path in entries.map(|entry| entry.unwrap().path()) {
        let name = path.file_stem().unwrap().to_str().unwrap().to_string();
        let inside = if module.is_empty() { name.clone() } else { format!("{module}::{name}") };
        if path.is_dir() {
            files(&path, &inside, found);
        } else if name == "mod" || name == "lib" {
            found.insert(module.to_string(), path);
        } else if name != "tests" {
            found.insert(inside, path);
        }
    }
}

/// The source without comments, and without what is compiled for tests alone.
fn code(text: &str) -> String {
    let mut kept = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        if line.starts_with("#[cfg(test)]") {
            // To the end of the item: a brace at the margin, or one line.
            let first = lines.next().unwrap_or_default();
            if !first.ends_with(';') {
                lines.by_ref().find(|line| line.starts_with('}'));
            }
        } else if !line.trim_start().starts_with("//") {
            kept.push_str(line);
            kept.push('\n');
        }
    }
    kept
}

/// All paths that begin with `head`, braces written out: `a::{b, c::{d}}` is `a::b` and `a::c::d`.
fn paths(code: &str, head: &str) -> Vec<String> {
    fn take<'a>(rest: &'a str, before: &str, found: &mut Vec<String>) -> &'a str {
        let end = rest.find(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':')).unwrap_or(rest.len());
        let (word, mut rest) = rest.split_at(end);
        let path = format!("{before}{word}");
        if !rest.starts_with('{') {
            found.push(path);
            return rest;
        }
        loop {
            rest = take(rest[1..].trim_start(), &path, found).trim_start();
            // A new name, and whatever else stands between two items.
            let next = rest.find([',', '}']).unwrap_or(rest.len());
            rest = &rest[next..];
            if rest.is_empty() || rest.starts_with('}') {
                return rest.get(1..).unwrap_or_default();
            }
        }
    }
    let mut found = Vec::new();
    for (at, _) in code.match_indices(head) {
        // Not `pub(in …)`, which opens to others and uses nothing.
        let before = &code[..at];
        if !before.ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':') && !before.ends_with("(in ") {
            take(&code[at..], "", &mut found);
        }
    }
    found
}

/// The file that holds what a path names: the longest beginning of it that is one.
fn file_of<'a>(files: &Files, path: &'a str) -> &'a str {
    let mut path = path;
    while !files.contains_key(path) {
        path = path.rfind("::").map_or("", |at| &path[..at]);
    }
    path
}

fn uses(files: &Files) -> Uses {
    let mut uses = Uses::new();
    for (module, path) in files {
        let code = code(&fs::read_to_string(path).unwrap());
        let own = uses.entry(module.clone()).or_default();
        let parent = |depth: usize| -> String {
            let parts: Vec<&str> = module.split("::").collect();
            parts[..parts.len().saturating_sub(depth)].join("::")
        };
        let mut named: Vec<String> = paths(&code, "crate::").iter().map(|p| p["crate::".len()..].to_string()).collect();
        for path in paths(&code, "super::") {
            let depth = path.matches("super::").count();
            named.push(format!("{}::{}", parent(depth), &path["super::".len() * depth..]));
        }
        // What it declares, and re-exports or uses of that without a prefix.
        for line in code.lines() {
            let words: Vec<&str> = line.split_whitespace().collect();
            if let Some(at) = words.iter().position(|w| *w == "mod").filter(|at| *at < 2 && line.ends_with(';')) {
                named.push(format!("{module}::{}", words[at + 1].trim_end_matches(';')));
            }
        }
        own.extend(named.iter().map(|path| file_of(files, path.trim_start_matches("::")).to_string()));
        own.remove(module);
    }
    uses
}

/// A way from a file back to itself, if there is one.
fn circle(uses: &Uses) -> Option<Vec<String>> {
    fn walk(at: &str, uses: &Uses, way: &mut Vec<String>, done: &mut BTreeSet<String>) -> Option<Vec<String>> {
        if let Some(start) = way.iter().position(|w| w == at) {
            return Some(way[start..].iter().cloned().chain([at.to_string()]).collect());
        }
        if !done.insert(at.to_string()) {
            return None;
        }
        way.push(at.to_string());
        let found = uses.get(at).into_iter().flatten().find_map(|next| walk(next, uses, way, done));
        way.pop();
        found
    }
    let mut done = BTreeSet::new();
    uses.keys().find_map(|start| walk(start, uses, &mut Vec::new(), &mut done))
}

fn core() -> Files {
    let mut found = Files::new();
    files(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), "", &mut found);
    found
}

#[test]
fn no_two_files_need_each_other() {
    let uses = uses(&core());
    assert!(uses.len() > 50, "only {} files", uses.len());
    assert_eq!(circle(&uses), None);
}

#[test]
fn no_room_uses_one_above_it_or_beside_it() {
    let room = |module: &str| module.split("::").next().unwrap_or_default().to_string();
    let row = |name: &str| ROOMS.iter().position(|row| row.contains(&name));
    let mut wrong = Vec::new();
    let mut arrows = BTreeSet::new();
    for (module, named) in uses(&core()) {
        for other in named {
            let (from, to) = (room(&module), room(&other));
            if from == to {
                continue;
            }
            let (Some(above), Some(below)) = (row(&from), row(&to)) else {
                panic!("{module} -> {other}: no such room")
            };
            // The ground reports errors; all other rooms of one row know nothing of each other.
            if below > above || (below == above && from != "ground") {
                wrong.push(format!("{module} -> {other}"));
            }
            arrows.insert((from, to));
        }
    }
    assert_eq!(wrong, Vec::<String>::new());
    // The arrows that are certainly there are seen.
    for (from, to) in [("fringes", "ground"), ("clouds", "surfaces"), ("weld", "surfaces"), ("python", "weld")] {
        assert!(arrows.contains(&(from.to_string(), to.to_string())), "{from} -> {to} is not seen");
    }
}

#[test]
fn a_type_has_a_name_of_its_own() {
    let mut homes = BTreeMap::<String, Vec<String>>::new();
    for (module, path) in core() {
        for line in code(&fs::read_to_string(path).unwrap()).lines().filter(|line| !line.starts_with(' ')) {
            let words: Vec<&str> = line.split(|c: char| !(c.is_alphanumeric() || c == '_')).collect();
            let at = words.iter().position(|w| ["struct", "enum", "trait", "type"].contains(w));
            if let Some(name) = at.and_then(|at| words.get(at + 1)).filter(|n| n.starts_with(char::is_uppercase)) {
                homes.entry((*name).to_string()).or_default().push(module.clone());
            }
        }
    }
    assert!(homes.len() > 150 && homes["Plane"] == ["surfaces::plane"], "{homes:?}");
    homes.retain(|_, modules| modules.len() > 1);
    assert_eq!(homes, BTreeMap::new());
}

#[test]
fn a_circle_is_found_and_paths_are_read() {
    let named = |a: &str, b: &[&str]| (a.to_string(), b.iter().map(ToString::to_string).collect());
    let uses: Uses = [named("a", &["b"]), named("b", &["c"]), named("c", &["b"])].into();
    assert_eq!(circle(&uses), Some(["b", "c", "b"].map(String::from).to_vec()));
    let read = paths("use super::{noise::{self, A as B}, super::wave::C};\n let x = super::y(1);", "super::");
    assert_eq!(read[..3], ["super::noise::self", "super::noise::A", "super::super::wave::C"]);
    assert!(read.contains(&"super::y".to_string()));
    assert_eq!(code("fn a() {}\n#[cfg(test)]\nmod tests {\n    x\n}\n// y\nfn b() {}\n"), "fn a() {}\nfn b() {}\n");
}
