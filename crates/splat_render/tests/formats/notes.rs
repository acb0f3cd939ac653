//! Omitted content is noted, and the rest is written.

use splat_render::io::write_splats;

use crate::scenes::{WRITABLE, by_way_of, folder, scene};

#[test]
fn losses_are_noted() {
    let folder = folder("lost");
    let mut file = scene(20, 4);
    file.origin = [1000.0, 0.0, 0.0];
    file.antialiased = true;
    // The words that each ending's notes must contain, and whether it drops SH of degree 4.
    let wanted: [(&str, &[&str], u32); 7] = [
        ("ply", &[], 4),
        ("compressed.ply", &["degree 4"], 3),
        ("splat", &["view-dependent", "origin", "antialiased"], 0),
        ("spz", &["origin", "degree 4"], 4),
        ("sog", &["degree 4", "origin"], 3),
        ("glb", &["degree 4", "antialiased"], 3),
        ("gltf", &["degree 4", "antialiased"], 3),
    ];
    for (ending, words, degree) in wanted {
        let (loaded, notes) = by_way_of(&folder, ending, &file);
        assert_eq!(notes.len(), words.len(), "{ending}: {notes:?}");
        for (note, word) in notes.iter().zip(words) {
            assert!(note.contains(word), "{ending}: {note}");
            assert!(note.ends_with('.') && !note.contains('\n'), "{note}");
        }
        assert_eq!(loaded.file.splats.sh_degree, degree, "{ending}");
        // With a stored origin, splats keep their places.
        let mean: f64 =
            loaded.file.splats.means.iter().map(|m| f64::from(m[0])).sum::<f64>() / 20.0;
        assert!((mean + loaded.file.origin[0] - 1000.0).abs() < 3.0, "{ending}");
    }
}

#[test]
fn invisible_splats_are_left_out_and_the_rest_is_written() {
    let folder = folder("nan");
    let mut file = scene(20, 1);
    file.splats.means[3][1] = f32::NAN;
    file.splats.scales[5][0] = f32::INFINITY;
    file.splats.sh[4 * 7 + 2][1] = f32::NAN;
    file.splats.opacities[9] = f32::NEG_INFINITY;
    file.splats.quats[11] = [0.0; 4];
    for ending in WRITABLE {
        let (loaded, notes) = by_way_of(&folder, ending, &file);
        if ending == "ply" {
            assert!(notes.is_empty() && loaded.file.splats.len() == 20);
            continue;
        }
        assert_eq!(loaded.file.splats.len(), 15, "{ending}");
        assert!(notes.iter().any(|note| note.starts_with("5 splats that cannot be drawn")));
    }
}

#[test]
fn values_beyond_the_range_are_clipped_and_counted() {
    let folder = folder("clipped");
    let mut file = scene(20, 1);
    file.splats.scales[2] = [-25.0, 1.0, 22.0];
    file.splats.sh[4 * 3] = [9.0, 0.0, -9.0];
    file.splats.sh[4 * 3 + 1] = [4.5, 0.0, -1.5];
    let counts = |ending: &str| {
        let (loaded, notes) = by_way_of(&folder, ending, &file);
        let finite = loaded.file.splats.scales.as_flattened().iter().all(|s| s.is_finite());
        assert!(finite, "{ending}");
        notes
            .iter()
            .filter(|note| note.contains("clipped"))
            .map(|note| note.split(' ').next().unwrap().parse::<usize>().unwrap())
            .collect::<Vec<_>>()
    };
    assert_eq!(counts("compressed.ply"), [2, 1]); // log-scales beyond 20, SH beyond 4
    assert_eq!(counts("splat"), [1]); // colors
    assert_eq!(counts("spz"), [2, 2, 2]); // DC, log-scales, SH
    assert_eq!(counts("sog"), [0usize; 0]);
    assert_eq!(counts("glb"), [0usize; 0]);
}

#[test]
fn positions_out_of_a_format_s_range_are_refused() {
    let path = folder("far").join("far.spz");
    let mut file = scene(3, 0);
    file.splats.means[1][2] = 1e9;
    let error = write_splats(&path, &file).unwrap_err().to_string();
    assert!(error.contains(".spz") && error.contains(".ply"), "{error}");
    assert!(!path.exists());
    // Nor does another error leave a temporary file.
    assert!(write_splats(&path.join("scene.ply"), &file).is_err());
    assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 0);
}

#[test]
fn endings_that_cannot_be_written_are_named() {
    let folder = folder("endings");
    for name in ["scene.ksplat", "scene.obj", "scene"] {
        let error = write_splats(&folder.join(name), &scene(3, 0)).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains(".glb"), "{error}");
    }
}
