//! Scenes in levels of detail: round trips within budgets, and damage.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use splat_render::fit::SplatArrays;
use splat_render::io::{SplatFile, write_splats};
use splat_render::levels::{
    INDEX, LevelsWritten, Manifest, Resident, coarsest, read_within, write_levels,
};

use crate::mutations::mutate;
use crate::scenes::{Numbers, folder};

/// Writes a scene to the folder, and its levels to the folder's `out`, in cells of about 100 splats.
fn write(folder: &Path, file: &SplatFile, levels: usize) -> LevelsWritten {
    let (scene, out) = (folder.join("scene.ply"), folder.join("out"));
    write_splats(&scene, file).expect("a scene");
    std::fs::create_dir(&out).expect("a folder");
    write_levels(&scene, &out, levels, 100, &mut || true).expect("levels").expect("all of it")
}

/// A field of splats, of SH degree 1, whose color changes along it.
fn field() -> SplatFile {
    let n = 40;
    let places = (0..n * n).map(|i| [(i % n) as f32 * 0.1, (i / n) as f32 * 0.1, 0.0]);
    let means: Vec<[f32; 3]> = places.collect();
    let sh = means.iter().flat_map(|m| [[m[0], m[1], 0.0], [0.1; 3], [0.0; 3], [-0.1; 3]]);
    let splats = SplatArrays {
        quats: vec![[0.9, 0.1, 0.2, 0.3]; n * n],
        scales: vec![[-3.0, -3.0, -5.0]; n * n],
        opacities: vec![2.0; n * n],
        sh: sh.collect(),
        sh_degree: 1,
        means,
    };
    SplatFile { splats, origin: [1000.5, 0.0, -7.0], antialiased: true }
}

/// A new folder of three levels of the field, in cells of about 100.
fn written(name: &str) -> PathBuf {
    let folder = folder(name);
    let done = write(&folder, &field(), 3);
    assert_eq!(done.counts[0], 1600);
    assert!((250..=450).contains(&done.counts[1]), "{done:?}");
    assert!((40..=120).contains(&done.counts[2]), "{done:?}");
    assert_eq!(done.cells, 16);
    folder.join("out")
}

fn index(folder: &Path) -> Value {
    let text = std::fs::read(folder.join(INDEX)).expect("an index");
    serde_json::from_slice(&text).expect("JSON")
}

fn store(folder: &Path, index: &Value) {
    std::fs::write(folder.join(INDEX), index.to_string()).expect("an index");
}

#[test]
fn each_budget_gives_the_finest_level_that_fits() {
    let folder = written("round");
    let (all, level) = read_within(&folder, 1600).expect("levels");
    assert_eq!((all.splats.len(), level), (1600, 0));
    assert_eq!((all.origin, all.antialiased), ([1000.5, 0.0, -7.0], true));
    let sorted = |splats: &SplatArrays| {
        let mut rows: Vec<_> =
            splats.means.iter().map(|m| [m[1], m[0]].map(|c| (c * 10.0).round() as i32)).collect();
        rows.sort_unstable();
        rows
    };
    assert_eq!(sorted(&all.splats), sorted(&field().splats));
    let (some, level) = read_within(&folder, 1599).expect("levels");
    assert_eq!(level, 1);
    assert!(some.splats.len() < 450);
    let error = read_within(&folder, 20).map(|_| ()).expect_err("too few").to_string();
    assert!(error.contains("coarsest level"), "{error}");
}

#[test]
fn the_files_have_the_published_layout() {
    let folder = written("layout");
    let index = index(&folder);
    assert_eq!((&index["version"], &index["lodLevels"]), (&json!(1), &json!(3)));
    assert_eq!(index["lodErrors"], json!(true));
    let counts: Vec<u64> = serde_json::from_value(index["counts"].clone()).expect("counts");
    assert_eq!(index["count"].as_u64(), Some(counts.iter().sum()));
    // Interior nodes have two children and the box around theirs; leaves have levels and errors.
    fn walk(node: &Value) -> ([f64; 3], [f64; 3]) {
        let corner = |node: &Value, name: &str| -> [f64; 3] {
            serde_json::from_value(node["bound"][name].clone()).expect("a corner")
        };
        let own = (corner(node, "min"), corner(node, "max"));
        if let Some(children) = node.get("children") {
            assert!(node.get("lods").is_none());
            let boxes: Vec<_> = children.as_array().expect("children").iter().map(walk).collect();
            assert_eq!(boxes.len(), 2);
            for k in 0..3 {
                assert_eq!(own.0[k], boxes[0].0[k].min(boxes[1].0[k]));
                assert_eq!(own.1[k], boxes[0].1[k].max(boxes[1].1[k]));
            }
        } else {
            let errors: Vec<f64> = serde_json::from_value(node["errors"].clone()).expect("errors");
            assert_eq!(errors.len(), 3);
            assert!(errors[0] == 0.0 && errors.is_sorted(), "{errors:?}");
            assert_eq!(node["lods"].as_object().expect("lods").len(), 3);
        }
        own
    }
    walk(&index["tree"]);
    // Runs cover each file, and a file has one level.
    let manifest = Manifest::read(&folder).expect("a manifest");
    for (file, name) in manifest.files.iter().enumerate() {
        let mut runs: Vec<(usize, usize, usize)> = Vec::new();
        for cell in &manifest.cells {
            for (level, run) in cell.runs.iter().enumerate() {
                runs.extend(run.filter(|r| r.file == file).map(|r| (r.offset, r.count, level)));
            }
        }
        runs.sort_unstable();
        let mut end = 0;
        for (offset, count, level) in &runs {
            assert_eq!((*offset, *level), (end, runs[0].2));
            end += count;
        }
        let path = folder.join(name.to_str().expect("a name"));
        let meta: Value =
            serde_json::from_slice(&std::fs::read(path).expect("a SOG")).expect("JSON");
        assert_eq!(meta["count"].as_u64(), Some(end as u64));
    }
    assert!(!folder.join(".cells").exists());
}

#[test]
fn the_same_scene_gives_the_same_files() {
    let (one, other) = (written("one"), written("other"));
    let files = |folder: &PathBuf| {
        let mut all = Vec::new();
        for entry in std::fs::read_dir(folder).expect("a folder").flatten() {
            match std::fs::read_dir(entry.path()) {
                Ok(inner) => all.extend(inner.flatten().map(|e| e.path())),
                Err(_) => all.push(entry.path()),
            }
        }
        all.sort();
        let read = |path: PathBuf| {
            let bytes = std::fs::read(&path).expect("bytes");
            (path.strip_prefix(folder).expect("inside").to_owned(), bytes)
        };
        all.into_iter().map(read).collect::<Vec<_>>()
    };
    assert_eq!(files(&one), files(&other));
}

#[test]
fn invalid_scenes_and_numbers_are_refused() {
    let folder = folder("refused");
    let scene = folder.join("scene.ply");
    let mut file = field();
    file.splats.means.fill([f32::NAN; 3]);
    write_splats(&scene, &file).expect("a scene");
    let say = |scene: &Path, levels, per_cell| {
        write_levels(scene, &folder, levels, per_cell, &mut || true)
            .expect_err("refused")
            .to_string()
    };
    assert!(say(&scene, 2, 100).contains("no finite splats"));
    assert!(say(&scene, 0, 100).contains("from 1 to 8 levels, not 0"));
    assert!(say(&scene, 9, 100).contains("from 1 to 8 levels, not 9"));
    assert!(say(&scene, 2, 0).contains("per_cell"));
    assert!(say(&folder.join("none.ply"), 2, 100).contains("none.ply"));
    write_splats(&scene, &field()).expect("a scene");
    let bytes = std::fs::read(&scene).expect("bytes");
    std::fs::write(&scene, &bytes[..bytes.len() - 50]).expect("cut");
    assert!(say(&scene, 2, 100).contains("truncated"));
}

#[test]
fn writing_stops_on_request() {
    let folder = folder("stop");
    write_splats(&folder.join("scene.ply"), &field()).expect("a scene");
    // While cells are found, while they are filled, before the first is merged, and after some.
    for asked in [0, 1, 2, 3] {
        let out = folder.join(format!("out{asked}"));
        std::fs::create_dir(&out).expect("a folder");
        let mut left = asked;
        let mut goes_on = || {
            left -= 1;
            left >= 0
        };
        let done = write_levels(&folder.join("scene.ply"), &out, 3, 100, &mut goes_on);
        assert_eq!(done.expect("no error"), None);
        assert_eq!(left, -1, "it does not stop");
        assert!(!out.join(INDEX).exists());
    }
}

#[test]
fn invalid_splats_are_left_out_and_counted() {
    let folder = folder("left");
    let mut file = field();
    file.splats.opacities[7] = f32::NAN;
    file.splats.quats[9] = [0.0; 4];
    let done = write(&folder, &file, 2);
    assert_eq!(done.counts[0], 1598);
    assert!(done.notes[0].starts_with("2 splats"), "{:?}", done.notes);
}

/// The first leaf of a tree.
fn leaf(mut node: &mut Value) -> &mut Value {
    while node.get("children").is_some() {
        node = &mut node["children"][0];
    }
    node
}

#[test]
fn an_invalid_index_is_one_message_that_names_it() {
    type Change = fn(&mut Value);
    let changes: [(&str, Change); 19] = [
        ("version 2", |m| m["version"] = json!(2)),
        ("lodLevels", |m| m["lodLevels"] = json!(0)),
        ("lodLevels", |m| m["lodLevels"] = json!(1e12)),
        ("filenames", |m| m["filenames"] = json!("0_0/meta.json")),
        ("not text", |m| m["filenames"][0] = json!(7)),
        ("is not in its folder", |m| m["filenames"][0] = json!("../scene.ply")),
        ("is not in its folder", |m| m["filenames"][0] = json!("/etc/passwd")),
        ("is not in its folder", |m| m["filenames"][0] = json!("a/../../b/meta.json")),
        ("is not in its folder", |m| m["filenames"][0] = json!("..\\b\\meta.json")),
        ("is not in its folder", |m| m["filenames"][0] = json!("C:meta.json")),
        ("is not in its folder", |m| m["environment"] = json!("http://a/b")),
        ("no tree", |m| drop(m.as_object_mut().expect("an object").remove("tree"))),
        ("children", |m| m["tree"] = json!({})),
        ("bound", |m| leaf(&mut m["tree"])["bound"]["min"] = json!([1e9, 0, 0])),
        ("valid count", |m| leaf(&mut m["tree"])["lods"]["0"]["count"] = json!(-1)),
        ("level \"7\"", |m| leaf(&mut m["tree"])["lods"]["7"] = json!({})),
        ("in file 999", |m| leaf(&mut m["tree"])["lods"]["0"]["file"] = json!(999)),
        ("two cells", |m| leaf(&mut m["tree"])["lods"]["0"]["file"] = json!(5)),
        ("errors", |m| leaf(&mut m["tree"])["errors"] = json!([0.0])),
    ];
    let folder = written("index");
    let whole = index(&folder);
    for (words, change) in changes {
        let mut index = whole.clone();
        change(&mut index);
        store(&folder, &index);
        let error = Manifest::read(&folder).expect_err(words).to_string();
        assert!(error.contains(words) && error.contains(INDEX), "{words}: {error}");
        assert_eq!(error.lines().count(), 1);
    }
    // An index by other programs, before the format had versions.
    let mut index = whole;
    for name in ["version", "asset", "count", "counts", "lodErrors", "origin"] {
        index.as_object_mut().expect("an object").remove(name);
    }
    index["environment"] = Value::Null;
    store(&folder, &index);
    let manifest = Manifest::read(&folder).expect("an older index");
    assert_eq!((manifest.cells.len(), manifest.origin), (16, [0.0; 3]));
    assert!(manifest.cells.iter().all(|c| c.errors[0] == 0.0 && c.errors[2] > c.errors[1]));
}

#[test]
fn damaged_bytes_of_an_index_never_panic() {
    let folder = written("bytes");
    let text = index(&folder).to_string().into_bytes();
    let mut numbers = Numbers(7);
    for _ in 0..2000 {
        let mut bytes = text.clone();
        mutate(&mut bytes, &mut numbers);
        std::fs::write(folder.join(INDEX), &bytes).expect("an index");
        if let Ok(manifest) = Manifest::read(&folder) {
            // Numbers that were accepted are within the files, or reported on reading.
            let mut resident = Resident::new(&manifest, 10_000).expect("no environment");
            let choice = coarsest(&manifest, resident.room());
            for file in resident.missing(&manifest, &choice) {
                let _ = resident.load(&manifest, &choice, file);
            }
            assert!(resident.most <= 10_000);
        }
    }
    // Deep nesting is an error, too, and not a stack that ends.
    let deep = "{\"children\":[".repeat(100_000);
    let index = format!("{{\"version\":1,\"lodLevels\":1,\"filenames\":[],\"tree\":{deep}");
    std::fs::write(folder.join(INDEX), index).expect("an index");
    Manifest::read(&folder).expect_err("too deep");
}

#[test]
fn missing_and_wrong_files_are_named() {
    let folder = written("files");
    let say = || read_within(&folder, 2000).map(|_| ()).expect_err("damage").to_string();
    // More than the index says, then fewer.
    let whole = index(&folder);
    let mut other = whole.clone();
    let count = leaf(&mut other["tree"])["lods"]["0"]["count"].as_u64().expect("a count");
    for wrong in [count - 1, count + 1] {
        leaf(&mut other["tree"])["lods"]["0"]["count"] = json!(wrong);
        store(&folder, &other);
        let error = say();
        let words = format!("holds {count} splats, but {INDEX} says {wrong}");
        assert!(error.contains(&words) && error.contains("0_0"), "{error}");
    }
    store(&folder, &whole);
    let meta = folder.join("0_0/meta.json");
    let text = std::fs::read_to_string(&meta).expect("text");
    for (old, new, words) in [
        ("means_l.webp", "../0_1/means_l.webp", "another folder"),
        ("means_l.webp", "/etc/passwd", "another folder"),
        ("means_l.webp", "nothing.webp", "nothing.webp"),
        ("\"version\":2", "\"version\":3", "version other than 2"),
    ] {
        std::fs::write(&meta, text.replace(old, new)).expect("text");
        let error = say();
        assert!(error.contains(words) && error.contains("0_0"), "{error}");
    }
    std::fs::remove_file(&meta).expect("gone");
    assert!(say().contains("0_0"));
}
