//! The models that a path means, and when they were written.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use splat_render::{Error, Result};

/// A model that can be shown.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Source {
    /// What people read.
    pub name: String,
    /// The file.
    pub path: PathBuf,
}

/// When a file was written, and its length.
pub type Stamp = (SystemTime, u64);

/// When a file was last written, and its length.
pub fn stamp(path: &Path) -> Option<Stamp> {
    let metadata = path.metadata().ok().filter(std::fs::Metadata::is_file)?;
    Some((metadata.modified().ok()?, metadata.len()))
}

/// The models at a path: the file itself, or those that a fit or a refinement has left in a folder,
/// the one to show first in front.
pub fn find_sources(path: &Path) -> Result<Vec<Source>> {
    if !path.is_dir() {
        let name = path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        return Ok(vec![Source { name, path: path.to_owned() }]);
    }
    let mut sources = Vec::new();
    let scene = path.join("scene.ply");
    if scene.is_file() {
        sources.push(Source { name: "scene".to_owned(), path: scene });
    }
    let rounds = names(&path.join("rounds"));
    let mut rounds: Vec<u32> = rounds.iter().filter_map(|name| name.parse().ok()).collect();
    rounds.sort_unstable();
    for round in rounds {
        let file = path.join("rounds").join(round.to_string()).join("scene.ply");
        if file.is_file() {
            sources.push(Source { name: format!("round {round}"), path: file });
        }
    }
    let mut checkpoints = vec![path.join("checkpoint.npz")];
    let kept = path.join("checkpoints");
    let mut kept_names = names(&kept);
    kept_names.sort();
    checkpoints.extend(kept_names.iter().filter(|n| n.ends_with(".npz")).map(|n| kept.join(n)));
    for file in checkpoints.into_iter().filter(|file| file.is_file()) {
        let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        sources.push(Source { name: stem, path: file });
    }
    if sources.is_empty() {
        return Err(Error::file(
            path,
            "holds no scene.ply, no rounds and no checkpoint; give a splat file or the folder of an \
             igsr fit or igsr refine",
        ));
    }
    // A scene is written when its fit ends: what is newer than it is under way.
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

/// A fit writes its last checkpoint about when it writes its scene: seconds apart say nothing.
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
    fn what_is_being_fitted_comes_first() {
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
    fn an_empty_folder_is_one_sentence() {
        let folder = folder("empty", &["notes.txt"]);
        let error = find_sources(&folder).expect_err("nothing there").to_string();
        assert!(error.contains("holds no scene.ply"), "{error}");
        fs::remove_dir_all(folder).expect("clean");
    }
}
