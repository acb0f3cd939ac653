//! The .ply reader and writer: round trips, and files that lie.

use std::path::PathBuf;

use splat_render::fit::SplatArrays;
use splat_render::io::{SplatFile, read_ply, write_ply};

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("igsr-ply-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn some(n: usize, degree: u32) -> SplatFile {
    let mut splats = SplatArrays::zeros(n, degree);
    let mut value = 0.5f32;
    let mut next = || {
        value = (value * 1.37 + 0.11) % 3.0;
        value
    };
    for i in 0..n {
        splats.means[i] = std::array::from_fn(|_| next());
        splats.quats[i] = std::array::from_fn(|_| next());
        splats.scales[i] = std::array::from_fn(|_| next());
        splats.opacities[i] = next();
    }
    for sh in &mut splats.sh {
        *sh = std::array::from_fn(|_| next());
    }
    SplatFile { splats, origin: [0.0; 3], antialiased: false }
}

#[test]
fn round_trips_bit_for_bit() {
    let folder = folder("round");
    for degree in 0..=4 {
        for n in [0, 1, 37] {
            let mut file = some(n, degree);
            if n == 37 {
                file.origin = [1e6, -0.1, 1.0 / 3.0];
            }
            let path = folder.join("scene.ply");
            write_ply(&path, &file).unwrap();
            assert_eq!(read_ply(&path).unwrap(), file, "degree {degree}, {n} splats");
        }
    }
    let left: Vec<_> = std::fs::read_dir(&folder).unwrap().collect();
    assert_eq!(left.len(), 1, "a temporary file was left behind");
}

#[test]
fn every_truncation_is_one_clear_error() {
    let folder = folder("cut");
    let path = folder.join("scene.ply");
    write_ply(&path, &some(3, 1)).unwrap();
    let whole = std::fs::read(&path).unwrap();
    for length in 0..whole.len() {
        std::fs::write(&path, &whole[..length]).unwrap();
        let error = read_ply(&path).unwrap_err().to_string();
        assert!(error.contains("scene.ply"), "{error}");
        assert!(!error.contains('\n'), "{error}");
    }
}

#[test]
fn lies_are_refused_before_memory_is_taken() {
    let folder = folder("lies");
    let path = folder.join("scene.ply");
    write_ply(&path, &some(3, 0)).unwrap();
    let whole = std::fs::read(&path).unwrap();
    let change = |from: &str, to: &str| {
        let text = String::from_utf8_lossy(&whole[..400]).replace(from, to);
        let mut bytes = text.into_bytes();
        bytes.extend(&whole[400..]);
        std::fs::write(&path, bytes).unwrap();
        read_ply(&path).unwrap_err().to_string()
    };
    assert!(change("vertex 3", "vertex 4000000000").contains("4000000000"));
    assert!(change("vertex 3", "vertex 1000000000").contains("truncated"));
    assert!(change("vertex 3", "vertex -3").contains("-3"));
    assert!(change("binary_little_endian", "ascii").contains("ascii"));
    assert!(change("float opacity", "float opazity").contains("opacity"));
    assert!(change("ply\n", "\u{ff}\u{d8}jpeg\n").contains("ply"));
    std::fs::write(&path, [b'a'; 10]).unwrap();
    assert!(read_ply(&path).is_err());
    assert!(read_ply(&folder.join("none.ply")).unwrap_err().to_string().contains("opened"));
}

#[test]
fn a_folder_that_cannot_be_written_is_an_error_and_keeps_the_old_file() {
    let folder = folder("keep");
    let path = folder.join("scene.ply");
    write_ply(&path, &some(2, 0)).unwrap();
    let before = std::fs::read(&path).unwrap();
    let missing = folder.join("missing").join("scene.ply");
    assert!(write_ply(&missing, &some(3, 0)).is_err());
    assert_eq!(std::fs::read(&path).unwrap(), before);
}
