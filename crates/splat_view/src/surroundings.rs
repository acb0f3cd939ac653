//! Files next to a scene in the folder of an igsr fit or refinement: cameras, and the background.

use std::io::Read;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde::de::DeserializeOwned;
use splat_render::io::open_file;

use crate::capture::find_cameras;

/// Folder that a running fit or refinement writes: cameras with their photos, and the background.
const VIEW: &str = "view";
/// Largest report that is read, bytes.
const REPORT_MAX: u64 = 64 << 20;

/// Folders that may belong to a scene, the nearest first: its parent, and the folder of the run whose
/// round or checkpoint it is (`DIR` for `DIR/rounds/3/scene.ply` and `DIR/checkpoints/whole.npz`).
fn folders_of(scene: &Path) -> Vec<PathBuf> {
    let own = if scene.is_dir() {
        scene.to_owned()
    } else {
        let parent = scene.parent().filter(|parent| !parent.as_os_str().is_empty());
        parent.unwrap_or(Path::new(".")).to_owned()
    };
    // Resolve names for relative paths such as `scene.ply` and `./scene.ply`.
    let whole = own.canonicalize().unwrap_or_else(|_| own.clone());
    let named = |path: &Path, name: &str| path.file_name().is_some_and(|own| own == name);
    let above = whole.parent().unwrap_or(&whole);
    let run = if named(above, "rounds") {
        above.parent()
    } else if named(&whole, "rounds") || named(&whole, "checkpoints") {
        Some(above)
    } else {
        None
    };
    let run = run.map(Path::to_owned);
    [Some(own), run].into_iter().flatten().collect()
}

/// The file of cameras that belongs to a scene: a finished run's, or the one of a run in progress.
pub fn cameras_beside(scene: &Path) -> Option<PathBuf> {
    let folders = folders_of(scene);
    let own = folders.iter().find_map(|folder| find_cameras(folder));
    own.or_else(|| folders.iter().find_map(|folder| find_cameras(&folder.join(VIEW))))
}

/// The background that a scene was fitted over, RGB in 0..1, if its folder says so.
pub fn background_beside(scene: &Path) -> Option<[f32; 3]> {
    folders_of(scene).iter().find_map(|folder| background_in(folder))
}

#[derive(Deserialize)]
struct Background {
    background: [f32; 3],
}

#[derive(Deserialize)]
struct FitReport {
    protocol: Background,
}

/// A refinement's report has the protocol of its last scores alone.
#[derive(Deserialize)]
struct RefineReport {
    test: FitReport,
}

fn background_in(folder: &Path) -> Option<[f32; 3]> {
    let run = read::<Background>(&folder.join(VIEW).join("run.json"));
    let report = || {
        let path = folder.join("report.json");
        let of_fit = read::<FitReport>(&path).map(|report| report.protocol);
        of_fit.or_else(|| read::<RefineReport>(&path).map(|report| report.test.protocol))
    };
    let color = run.or_else(report)?.background;
    color.iter().all(|channel| (0.0..=1.0).contains(channel)).then_some(color)
}

/// Reads a type from a JSON file; None if there is no such file, or it does not match.
fn read<T: DeserializeOwned>(path: &Path) -> Option<T> {
    let mut bytes = Vec::new();
    open_file(path).ok()?.take(REPORT_MAX).read_to_end(&mut bytes).ok()?;
    serde_json::from_slice(&bytes).ok()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn run_folder(name: &str, files: &[(&str, &str)]) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("splat-view-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        for (file, text) in files {
            let path = folder.join(file);
            fs::create_dir_all(path.parent().expect("parent")).expect("folder");
            fs::write(path, text).expect("file");
        }
        folder
    }

    #[test]
    fn cameras_are_found_from_every_file_of_a_run_and_from_no_other() {
        let files = ["rounds/2/scene.ply", "checkpoints/whole.npz", "scene.ply", "other/scene.ply"];
        let files: Vec<(&str, &str)> =
            files.iter().map(|&file| (file, "")).chain([("cameras.json", "")]).collect();
        let folder = run_folder("around", &files);
        let expected = fs::canonicalize(folder.join("cameras.json")).expect("it is there");
        for (file, _) in &files[..3] {
            let found = cameras_beside(&folder.join(file)).expect(file);
            assert_eq!(found.canonicalize().expect("it is there"), expected);
        }
        assert!(cameras_beside(&folder.join("rounds/2")).is_some());
        assert!(cameras_beside(&folder.join("rounds")).is_some());
        assert_eq!(cameras_beside(&folder.join("other/scene.ply")), None);
        // Cameras nearer by come first.
        fs::write(folder.join("rounds/2/cameras.json"), "").expect("write");
        let found = cameras_beside(&folder.join("rounds/2/scene.ply")).expect("cameras");
        assert_eq!(found, folder.join("rounds/2/cameras.json"));
        fs::remove_dir_all(folder).expect("clean");
    }

    #[test]
    fn a_running_fit_uses_the_given_cameras_until_it_writes_its_own() {
        let folder = run_folder("running", &[("checkpoint.npz", ""), ("view/cameras.json", "")]);
        let checkpoint = folder.join("checkpoint.npz");
        assert_eq!(cameras_beside(&checkpoint), Some(folder.join("view/cameras.json")));
        fs::write(folder.join("cameras.json"), "").expect("write");
        assert_eq!(cameras_beside(&checkpoint), Some(folder.join("cameras.json")));
        fs::remove_dir_all(folder).expect("clean");
    }

    #[test]
    fn the_background_is_the_fit_s_or_the_refinement_s() {
        let cases = [
            ("report.json", r#"{"protocol": {"background": [1, 1, 0.5], "x": 1}}"#, true),
            (
                "report.json",
                r#"{"test": {"psnr": 1, "protocol": {"background": [1, 1, 0.5]}}}"#,
                true,
            ),
            ("view/run.json", r#"{"background": [1, 1, 0.5]}"#, true),
            ("report.json", r#"{"protocol": {"background": [2, 1, 0.5]}}"#, false),
            ("report.json", r#"{"protocol": {"background": "white"}, "test": null}"#, false),
            ("report.json", "[[[[", false),
        ];
        for (file, text, is_known) in cases {
            let folder = run_folder("background", &[("rounds/0/scene.ply", ""), (file, text)]);
            let found = background_beside(&folder.join("rounds/0/scene.ply"));
            assert_eq!(found, is_known.then_some([1.0, 1.0, 0.5]), "{text}");
            fs::remove_dir_all(folder).expect("clean");
        }
    }
}
