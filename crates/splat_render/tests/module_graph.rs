//! The modules' arrows: none runs in a circle, and none runs up the layers.
//!
//! An arrow goes from a module to the one that defines what it names, in `use` and in paths, through
//! re-exports. Tests within modules do not count.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Top-level modules from the lowest layer to the highest. Modules of one layer do not know each
/// other.
const LAYERS: [&[&str]; 7] = [
    &["constants", "error", "morton"],
    &["camera", "sh"],
    &["splats", "target"],
    &["stages"],
    &["fit_device"],
    &["reference", "cpu", "gpu", "io"],
    &["fit", "gpu_check", "levels"],
];

/// Names of a path, `crate` left out.
type Names = Vec<String>;

/// What a module names.
#[derive(Default)]
struct Module {
    /// Paths by the name that they have here, and whether others may use that name.
    uses: Vec<(Names, String, bool)>,
    /// Paths in code.
    paths: Vec<Names>,
    /// Single names in code.
    words: BTreeSet<String>,
}

/// Identifiers and punctuation, without comments, strings and what only tests are compiled with.
fn tokens(source: &str) -> Vec<String> {
    let chars: Vec<char> = source.chars().collect();
    let (mut out, mut i) = (Vec::<String>::new(), 0);
    while i < chars.len() {
        let rest = |text: &str| text.chars().zip(&chars[i..]).all(|(a, b)| a == *b);
        let word = |c: char| c.is_alphanumeric() || c == '_';
        if rest("//") {
            while i < chars.len() && chars[i] != '\n' {
                i += 1;
            }
        } else if chars[i] == '"' {
            i += 1;
            while i < chars.len() && chars[i] != '"' {
                i += if chars[i] == '\\' { 2 } else { 1 };
            }
            i += 1;
        } else if chars[i] == '\'' && chars.get(i + 2) == Some(&'\'') {
            i += 3;
        } else if rest("'\\") {
            i += 4;
        } else if word(chars[i]) {
            let start = i;
            while i < chars.len() && word(chars[i]) {
                i += 1;
            }
            out.push(chars[start..i].iter().collect());
        } else if rest("::") {
            out.push("::".into());
            i += 2;
        } else {
            if !chars[i].is_whitespace() {
                out.push(chars[i].into());
            }
            i += 1;
        }
    }
    without_tests(&out)
}

/// Drops each item behind `#[cfg(test)]`, up to its `;` or the end of its braces.
fn without_tests(tokens: &[String]) -> Vec<String> {
    let mark = ["#", "[", "cfg", "(", "test", ")", "]"];
    let (mut out, mut i) = (Vec::new(), 0);
    while i < tokens.len() {
        if !tokens[i..].iter().zip(mark).all(|(a, b)| a == b) || tokens.len() - i < mark.len() {
            out.push(tokens[i].clone());
            i += 1;
            continue;
        }
        let mut depth = 0;
        while i < tokens.len() {
            depth += i32::from(tokens[i] == "{") - i32::from(tokens[i] == "}");
            let ends = tokens[i] == ";" || tokens[i] == "}";
            i += 1;
            if ends && depth == 0 {
                break;
            }
        }
    }
    out
}

/// Reads `a::{b as c, d::*}` from `at` on: full paths with the names they get.
fn tree(tokens: &[String], at: &mut usize, before: &Names, out: &mut Vec<(Names, String)>) {
    let mut path = before.clone();
    while *at < tokens.len() {
        let token = tokens[*at].as_str();
        *at += 1;
        match token {
            "::" => {}
            "{" => {
                while tokens[*at] != "}" {
                    tree(tokens, at, &path, out);
                    if tokens[*at] == "," {
                        *at += 1;
                    }
                }
                *at += 1;
                return;
            }
            name => {
                path.push(name.into());
                if tokens.get(*at).is_none_or(|next| next != "::") {
                    break;
                }
            }
        }
    }
    if path.last().is_some_and(|last| last == "self") {
        path.pop();
    }
    let mut name = path.last().cloned().unwrap_or_default();
    if tokens.get(*at).is_some_and(|next| next == "as") {
        name = tokens[*at + 1].clone();
        *at += 2;
    }
    out.push((path, name));
}

/// `path` as seen from `module`, from the crate's root on; None where it leads to another crate.
fn absolute(module: &[String], path: &[String], modules: &BTreeSet<Names>) -> Option<Names> {
    let mut at = module.to_vec();
    let mut path = path;
    match path.first()?.as_str() {
        "crate" => at.clear(),
        "self" => {}
        "super" => {
            while path.first().is_some_and(|first| first == "super") {
                at.pop();
                path = &path[1..];
            }
            at.extend(path.iter().cloned());
            return Some(at);
        }
        first => {
            at.push(first.into());
            if !modules.contains(&at) {
                return None;
            }
            at.pop();
            at.extend(path.iter().cloned());
            return Some(at);
        }
    }
    at.extend(path[1..].iter().cloned());
    Some(at)
}

/// Modules by their path, and the modules that each names.
struct Graph(BTreeMap<Names, BTreeSet<Names>>);

impl Graph {
    /// Of sources by module path.
    fn new(sources: &BTreeMap<Names, String>) -> Self {
        let names: BTreeSet<Names> = sources.keys().cloned().collect();
        let modules: BTreeMap<Names, Module> =
            sources.iter().map(|(name, source)| (name.clone(), parse(source))).collect();
        let mut arrows = BTreeMap::new();
        for (name, module) in &modules {
            let mut to = BTreeSet::new();
            for (path, known_as, open) in &module.uses {
                let Some(path) = absolute(name, path, &names) else { continue };
                // What a module only passes on from within itself is no dependency of its own.
                let within = path.starts_with(name) && *open;
                if !within || module.words.contains(known_as) {
                    to.extend(defined_in(&path, &modules, &names, 0));
                }
            }
            for path in &module.paths {
                let Some(path) = absolute(name, path, &names) else { continue };
                to.extend(defined_in(&path, &modules, &names, 0));
            }
            to.remove(name);
            arrows.insert(name.clone(), to);
        }
        Self(arrows)
    }

    /// Of all `.rs` files under a folder.
    fn of_folder(folder: &Path) -> Self {
        fn walk(folder: &Path, name: &Names, out: &mut BTreeMap<Names, String>) {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                let stem = path.file_stem().unwrap().to_str().unwrap().to_owned();
                let child = [name.as_slice(), std::slice::from_ref(&stem)].concat();
                if path.is_dir() {
                    walk(&path, &child, out);
                } else if path.extension().is_some_and(|e| e == "rs") && stem != "tests" {
                    let own = matches!(stem.as_str(), "mod" | "lib" | "main");
                    let source = std::fs::read_to_string(&path).unwrap();
                    out.insert(if own { name.clone() } else { child }, source);
                }
            }
        }
        let mut sources = BTreeMap::new();
        walk(folder, &Vec::new(), &mut sources);
        Self::new(&sources)
    }

    /// A circle of arrows, if there is one.
    fn cycle(&self) -> Option<Vec<String>> {
        fn visit(
            graph: &Graph,
            at: &Names,
            path: &mut Vec<Names>,
            done: &mut BTreeSet<Names>,
        ) -> Option<Vec<String>> {
            if let Some(start) = path.iter().position(|on_path| on_path == at) {
                let circle = path[start..].iter().chain([at]);
                return Some(circle.map(|name| name.join("::")).collect());
            }
            if !done.insert(at.clone()) {
                return None;
            }
            path.push(at.clone());
            let found = graph.0[at].iter().find_map(|next| visit(graph, next, path, done));
            path.pop();
            found
        }
        let mut done = BTreeSet::new();
        self.0.keys().find_map(|start| visit(self, start, &mut Vec::new(), &mut done))
    }

    /// Arrows between top-level modules that do not run down `layers`.
    fn upward(&self, layers: &[&[&str]]) -> Vec<String> {
        let layer = |name: &Names| layers.iter().position(|layer| layer.contains(&&*name[0]));
        let mut out = Vec::new();
        for (from, to) in &self.0 {
            for to in to.iter().filter(|to| !from.is_empty() && !to.is_empty()) {
                let down = matches!((layer(from), layer(to)), (Some(a), Some(b)) if a > b);
                if from[0] != to[0] && !down {
                    out.push(format!("{} -> {}", from.join("::"), to.join("::")));
                }
            }
        }
        out
    }
}

fn parse(source: &str) -> Module {
    let tokens = tokens(source);
    let (mut module, mut i) = (Module::default(), 0);
    // Whether the item that begins here is `pub` or `pub(...)`.
    let mut open = false;
    while i < tokens.len() {
        if tokens[i] == "use" {
            let mut found = Vec::new();
            i += 1;
            tree(&tokens, &mut i, &Vec::new(), &mut found);
            module.uses.extend(found.into_iter().map(|(path, name)| (path, name, open)));
            open = false;
            continue;
        }
        // What may see an item is no dependency of it.
        if tokens[i] == "pub" && tokens.get(i + 1).is_some_and(|next| next == "(") {
            i += tokens[i..].iter().position(|token| token == ")").unwrap_or(0) + 1;
            open = true;
            continue;
        }
        open = tokens[i] == "pub";
        let mut path = vec![tokens[i].clone()];
        i += 1;
        while tokens.get(i).is_some_and(|next| next == "::") && i + 1 < tokens.len() {
            path.push(tokens[i + 1].clone());
            i += 2;
        }
        module.words.insert(path[0].clone());
        if path.len() > 1 {
            module.paths.push(path);
        }
    }
    module
}

/// The module that defines what an absolute path names, through re-exports.
fn defined_in(
    path: &[String],
    modules: &BTreeMap<Names, Module>,
    names: &BTreeSet<Names>,
    depth: usize,
) -> Option<Names> {
    assert!(depth < 20, "re-exports of {path:?} go round");
    let length = (0..=path.len()).rev().find(|&length| names.contains(&path[..length]))?;
    let (module, rest) = path.split_at(length);
    if let Some(item) = rest.first() {
        let passed_on = modules[module].uses.iter().find(|(_, name, open)| *open && name == item);
        if let Some(target) = passed_on.and_then(|(path, ..)| absolute(module, path, names)) {
            return defined_in(&target, modules, names, depth + 1);
        }
    }
    // A crate's root defines nothing that its modules name.
    (!module.is_empty()).then(|| module.to_vec())
}

fn own() -> Graph {
    Graph::of_folder(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"))
}

#[test]
fn no_arrow_runs_in_a_circle() {
    assert_eq!(own().cycle(), None);
}

#[test]
fn no_arrow_runs_up_the_layers() {
    let graph = own();
    assert_eq!(graph.upward(&LAYERS), Vec::<String>::new());
    let known: Vec<&str> = LAYERS.concat();
    for name in graph.0.keys().filter(|name| name.len() == 1) {
        assert!(known.contains(&&*name[0]), "{} is in no layer", name[0]);
    }
    // The arrows are found at all.
    let arrows: usize = graph.0.values().map(BTreeSet::len).sum();
    assert!(arrows > 150, "only {arrows} arrows in {} modules", graph.0.len());
}

#[test]
fn circles_and_upward_arrows_are_found() {
    let graph = |files: &[(&str, &str)]| {
        let name = |path: &str| -> Names {
            path.split("::").filter(|name| !name.is_empty()).map(String::from).collect()
        };
        Graph::new(&files.iter().map(|(path, text)| (name(path), (*text).into())).collect())
    };
    let siblings = [
        ("", "mod a;"),
        ("a", "mod b; mod c; pub use b::B;"),
        ("a::b", "use super::c::{self, C as D}; pub struct B;"),
        ("a::c", "pub struct C; fn f() { let _ = super::B; }"),
    ];
    assert_eq!(graph(&siblings).cycle().unwrap(), ["a::b", "a::c", "a::b"]);
    let with_parent =
        [("", ""), ("a", "mod b; use b::g; pub struct A;"), ("a::b", "use super::A;")];
    assert_eq!(graph(&with_parent).cycle().unwrap().len(), 3);
    let facade = [("", ""), ("a", "mod b; pub use b::g; pub struct A;"), ("a::b", "use super::A;")];
    assert_eq!(graph(&facade).cycle(), None);
    let tested =
        [("", ""), ("a", "#[cfg(test)] mod t { use crate::b::B; }"), ("b", "use crate::a;")];
    assert_eq!(graph(&tested).cycle(), None);
    let layers: [&[&str]; 2] = [&["low", "lower"], &["high"]];
    let upward = [
        ("", "pub use high::H;"),
        ("low", "use crate::H; // use crate::lower;"),
        ("lower", "const S: &str = \"crate::high\"; fn f() { crate::low::g() }"),
        ("high", "use crate::{low, lower::x}; pub struct H;"),
    ];
    assert_eq!(graph(&upward).upward(&layers), ["low -> high", "lower -> low"]);
}
