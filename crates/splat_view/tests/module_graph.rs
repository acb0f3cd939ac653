//! No module of the viewer imports, over others or directly, from one that imports from it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The modules that a file names after `crate::`, singly or in braces. Tests at its end do not count.
fn imports(text: &str) -> BTreeSet<String> {
    let code = text.split("#[cfg(test)]").next().unwrap_or_default();
    let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
    let code: String = lines.collect::<Vec<_>>().join("\n");
    let mut found = BTreeSet::new();
    for rest in code.split("crate::").skip(1) {
        let names = match rest.strip_prefix('{') {
            Some(list) => list.split('}').next().unwrap_or_default().split(',').collect(),
            None => vec![rest],
        };
        for name in names {
            let is_name = |c: char| c.is_alphanumeric() || c == '_';
            found.insert(name.trim().split(|c| !is_name(c)).next().unwrap_or_default().to_owned());
        }
    }
    found
}

/// A way from a module back to itself, if there is one.
fn cycle(graph: &BTreeMap<String, BTreeSet<String>>) -> Option<Vec<String>> {
    fn walk(
        graph: &BTreeMap<String, BTreeSet<String>>,
        path: &mut Vec<String>,
        done: &mut BTreeSet<String>,
    ) -> Option<Vec<String>> {
        let module = path.last()?.clone();
        for next in graph.get(&module)? {
            if let Some(at) = path.iter().position(|seen| seen == next) {
                return Some([&path[at..], std::slice::from_ref(next)].concat());
            }
            if !done.contains(next) {
                path.push(next.clone());
                let found = walk(graph, path, done);
                if found.is_some() {
                    return found;
                }
                path.pop();
            }
        }
        done.insert(module);
        None
    }
    let mut done = BTreeSet::new();
    graph.keys().find_map(|module| walk(graph, &mut vec![module.clone()], &mut done))
}

#[test]
fn the_modules_import_each_other_without_a_cycle() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut graph = BTreeMap::new();
    for entry in std::fs::read_dir(folder).expect("the sources") {
        let path = entry.expect("an entry").path();
        if path.extension().is_some_and(|ending| ending == "rs") {
            let name = path.file_stem().expect("a name").to_string_lossy().into_owned();
            let text = std::fs::read_to_string(&path).expect("a source");
            assert!(!text.contains("use super::super"), "{name}: modules here are flat");
            graph.insert(name, imports(&text));
        }
    }
    graph.remove("main");
    let known: BTreeSet<_> = graph.keys().cloned().collect();
    let edges: usize = graph.values().map(BTreeSet::len).sum();
    assert!(known.len() > 20 && edges > 40, "{} modules, {edges} imports", known.len());
    for (module, imported) in &graph {
        let unknown: Vec<_> = imported.difference(&known).collect();
        assert!(unknown.is_empty(), "{module} imports {unknown:?}, which are no files of src");
    }
    let found = cycle(&graph).map(|path| path.join(" -> "));
    assert_eq!(found, None, "a cycle of imports");
}

#[test]
fn a_cycle_is_found() {
    let module = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
    let graph: BTreeMap<String, BTreeSet<String>> = [
        ("a".to_owned(), imports("use crate::{b, c};\nfn f() { crate::d::g() }")),
        ("b".to_owned(), module(&[])),
        ("c".to_owned(), module(&["b", "d"])),
        ("d".to_owned(), module(&["c"])),
    ]
    .into();
    assert_eq!(graph["a"], module(&["b", "c", "d"]));
    assert_eq!(cycle(&graph), Some(["c", "d", "c"].map(str::to_owned).to_vec()));
}
