//! The models at a path, and when they were written.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use splat_render::levels::INDEX;
use splat_render::{Error, Result};

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Source {
    pub name: String,
    pub path: PathBuf,
    /// The folder that was named, or the one that the file lies in.
    pub folder: PathBuf,
}

/// Label of a source; with its folder if another source has the same name.
pub fn label(source: &Source, among: &[Source]) -> String {
    let alike = |other: &&Source| other.name == source.name && other.path != source.path;
    let mut twins = among.iter().filter(alike).peekable();
    if twins.peek().is_none() {
        return source.name.clone();
    }
    let short = folder_name(&source.folder);
    let folder = if twins.any(|other| folder_name(&other.folder) == short) {
        source.folder.display().to_string()
    } else {
        short
    };
    format!("{folder}: {}", source.name)
}

/// The last part of a folder's path, also of one such as `.` or `..`.
fn folder_name(folder: &Path) -> String {
    let last = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
    last(folder)
        .or_else(|| last(&folder.canonicalize().ok()?))
        .unwrap_or_else(|| folder.display().to_string())
}

pub type Stamp = (SystemTime, u64);

/// When a file was last written, and its length.
pub fn stamp(path: &Path) -> Option<Stamp> {
    let metadata = path.metadata().ok().filter(std::fs::Metadata::is_file)?;
    Some((metadata.modified().ok()?, metadata.len()))
}

/// The models at a path: the file, or a folder's models of a fit or refinement, default first.
pub fn find_sources(path: &Path) -> Result<Vec<Source>> {
    if !path.is_dir() {
        let name = path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        let folder = folder.unwrap_or(Path::new(".")).to_owned();
        return Ok(vec![Source { name, path: path.to_owned(), folder }]);
    }
    // A scene in levels of detail is the folder, whatever else lies there.
    let index = path.join(INDEX);
    if index.is_file() {
        return Ok(vec![Source { name: INDEX.to_owned(), path: index, folder: path.to_owned() }]);
    }
    let mut sources = Vec::new();
    let mut add = |name: String, file: PathBuf| {
        if file.is_file() {
            sources.push(Source { name, path: file, folder: path.to_owned() });
        }
    };
    add("scene".to_owned(), path.join("scene.ply"));
    let rounds = names(&path.join("rounds"));
    let mut rounds: Vec<u32> = rounds.iter().filter_map(|name| name.parse().ok()).collect();
    rounds.sort_unstable();
    for round in rounds {
        let file = path.join("rounds").join(round.to_string()).join("scene.ply");
        add(format!("round {round}"), file);
    }
    let mut checkpoints = vec![path.join("checkpoint.npz")];
    let kept = path.join("checkpoints");
    let mut kept_names = names(&kept);
    kept_names.sort();
    checkpoints.extend(kept_names.iter().filter(|n| n.ends_with(".npz")).map(|n| kept.join(n)));
    for file in checkpoints {
        let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        add(stem, file);
    }
    if sources.is_empty() {
        return Err(Error::file(
            path,
            "holds no scene.ply, rounds, checkpoint or lod-meta.json; give a splat file or the folder of an \
             igsr fit or igsr refine",
        ));
    }
    // A scene is written when its fit ends: a newer checkpoint belongs to a fit in progress.
    let stamps: Vec<_> = sources.iter().map(|source| stamp(&source.path)).collect();
    let newest = (0..sources.len()).max_by_key(|&i| stamps[i]).unwrap_or(0);
    let is_under_way = sources[newest].path.extension().is_some_and(|ending| ending == "npz");
    let has_scene = sources[0].name == "scene";
    if !has_scene || (is_under_way && is_clearly_newer(stamps[newest], stamps[0])) {
        let first = sources.remove(newest);
        sources.insert(0, first);
    }
    Ok(sources)
}

/// More than two seconds newer: a fit writes its last checkpoint and its scene at about the same time.
fn is_clearly_newer(one: Option<Stamp>, other: Option<Stamp>) -> bool {
    one.zip(other).is_some_and(|((one, _), (other, _))| {
        one.duration_since(other).is_ok_and(|gap| gap.as_secs() > 2)
    })
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().into_string().ok()).collect()
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::time::Duration;

    use super::*;

    fn folder(name: &str, files: &[&str]) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("splat-view-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        for file in files {
            let path = folder.join(file);
            fs::create_dir_all(path.parent().expect("parent")).expect("folder");
            fs::write(path, "x").expect("file");
        }
        folder
    }

    fn names_of(folder: &Path) -> Vec<String> {
        find_sources(folder).expect("sources").into_iter().map(|s| s.name).collect()
    }

    fn set_age(path: &Path, seconds: u64) {
        let file = fs::File::options().write(true).open(path).expect("open");
        file.set_modified(SystemTime::now() - Duration::from_secs(seconds)).expect("time");
    }

    #[test]
    fn a_refinement_lists_its_scene_then_rounds_in_order() {
        let files = ["rounds/10/scene.ply", "rounds/2/scene.ply", "scene.ply", "rounds/0/x.png"];
        let folder = folder("refine", &[&files[..], &["checkpoints/whole.npz"]].concat());
        assert_eq!(names_of(&folder), ["scene", "round 2", "round 10", "whole"]);
        fs::remove_dir_all(folder).expect("clean");
    }

    #[test]
    fn the_newest_scene_comes_first() {
        let folder = folder("fit", &["scene.ply", "checkpoint.npz"]);
        assert_eq!(names_of(&folder), ["scene", "checkpoint"]);
        set_age(&folder.join("scene.ply"), 100);
        assert_eq!(names_of(&folder), ["checkpoint", "scene"]);
        fs::remove_dir_all(folder).expect("clean");
    }

    #[test]
    fn a_change_shows_in_the_stamp_and_a_missing_file_has_none() {
        let folder = folder("change", &["scene.ply"]);
        let path = folder.join("scene.ply");
        let before = stamp(&path);
        assert!(before.is_some() && before == stamp(&path));
        fs::write(&path, "longer").expect("write");
        assert!(stamp(&path) != before);
        assert_eq!(stamp(&folder), None);
        fs::remove_dir_all(folder).expect("clean");
        assert_eq!(stamp(&path), None);
    }

    #[test]
    fn sources_of_one_name_are_told_apart_by_their_folders() {
        let folder = folder(
            "alike",
            &["a/scene.ply", "b/scene.ply", "b/rounds/0/scene.ply", "c/a/scene.ply"],
        );
        let labels = |folders: &[&str]| -> Vec<String> {
            let found = folders.iter().map(|name| find_sources(&folder.join(name)));
            let sources: Vec<_> = found.flat_map(|found| found.expect("sources")).collect();
            sources.iter().map(|source| label(source, &sources)).collect()
        };
        assert_eq!(labels(&["b"]), ["scene", "round 0"]);
        assert_eq!(labels(&["a", "b"]), ["a: scene", "b: scene", "round 0"]);
        assert_eq!(labels(&["a/scene.ply", "b/scene.ply"]), ["a: scene.ply", "b: scene.ply"]);
        let whole = ["a", "c/a"].map(|name| format!("{}: scene", folder.join(name).display()));
        assert_eq!(labels(&["a", "c/a"]), whole);
        fs::remove_dir_all(folder).expect("clean");
    }

    #[test]
    fn an_empty_folder_is_an_error_message() {
        let folder = folder("empty", &["notes.txt"]);
        let error = find_sources(&folder).expect_err("nothing there").to_string();
        assert!(error.contains("holds no scene.ply"), "{error}");
        fs::remove_dir_all(folder).expect("clean");
    }
}
