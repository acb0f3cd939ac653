//! Round trips are within the steps of the format's numbers.

use splat_render::io::{Format, read_splats, write_splats};

use crate::scenes::{Apart, WRITABLE, by_way_of, folder, scene};

const N: usize = 700;
/// Half a step of a byte.
const HALF_BYTE: f64 = 0.5 / 255.0;

/// The largest error of a quaternion whose three smallest components are off by `e`: the largest
/// component, at least 1/2, is then off by 3 e.
fn smallest_three(e: f32) -> f32 {
    12.0f32.sqrt() * e
}

#[test]
fn ply_keeps_every_bit() {
    for degree in 0..=4 {
        let mut file = scene(N, degree);
        file.origin = [1e6, -0.1, 1.0 / 3.0];
        file.antialiased = degree % 2 == 0;
        let (loaded, notes) = by_way_of(&folder("ply"), "ply", &file);
        assert_eq!(loaded.file, file);
        assert_eq!(loaded.format, Format::Ply);
        assert!(notes.is_empty() && loaded.notes.is_empty());
    }
}

#[test]
fn compressed_ply_is_within_its_steps() {
    for degree in 0..=3 {
        let mut file = scene(N, degree);
        file.origin = [1e6, -0.1, 1.0 / 3.0];
        file.antialiased = true;
        let (loaded, notes) = by_way_of(&folder("compressed"), "compressed.ply", &file);
        assert_eq!(loaded.format, Format::CompressedPly);
        assert_eq!((loaded.file.origin, loaded.file.antialiased), (file.origin, true));
        assert!(notes.is_empty(), "{notes:?}");
        let apart = Apart::of(&file.splats, &loaded.file.splats);
        // At least 10 bits over a chunk, whose size is at most the scene's.
        assert!(apart.mean <= 6.0 / 1023.0 / 2.0 + 1e-6, "{apart:?}");
        assert!(apart.scale <= 6.0 / 1023.0 / 2.0 + 1e-6, "{apart:?}");
        assert!(apart.quat <= smallest_three(2.0f32.sqrt() / 1023.0 / 2.0), "{apart:?}");
        assert!(apart.color <= HALF_BYTE + 1e-6, "{apart:?}");
        assert!(apart.opacity <= HALF_BYTE + 1e-6, "{apart:?}");
        assert!(apart.rest <= 8.0 / 256.0 / 2.0 + 1e-6, "{apart:?}");
        assert_eq!(degree > 0, apart.rest > 0.0);
    }
}

#[test]
fn splat_is_within_its_steps() {
    let file = scene(N, 0);
    let (loaded, notes) = by_way_of(&folder("splat"), "splat", &file);
    assert_eq!(loaded.format, Format::Splat);
    assert!(notes.is_empty(), "{notes:?}");
    let apart = Apart::of(&file.splats, &loaded.file.splats);
    assert_eq!(apart.mean, 0.0);
    assert!(apart.scale <= 2e-6, "{apart:?}");
    // Half a step of 1/128, and a whole one for a component of 1, which has no byte.
    assert!(apart.quat <= 0.0104, "{apart:?}");
    assert!(apart.color <= HALF_BYTE + 1e-6, "{apart:?}");
    assert!(apart.opacity <= HALF_BYTE + 1e-6, "{apart:?}");
}

#[test]
fn spz_is_within_its_steps() {
    for degree in 0..=4 {
        let mut file = scene(N, degree);
        file.antialiased = degree % 2 == 1;
        let (loaded, notes) = by_way_of(&folder("spz"), "spz", &file);
        assert_eq!(loaded.format, Format::Spz);
        assert_eq!(loaded.file.antialiased, file.antialiased);
        assert_eq!(notes.len(), usize::from(degree == 4), "{notes:?}");
        let apart = Apart::of(&file.splats, &loaded.file.splats);
        // 24 bits over -4 to 4.
        assert!(apart.mean <= (-22f32).exp2(), "{apart:?}");
        assert!(apart.scale <= 1.0 / 32.0 + 1e-6, "{apart:?}");
        assert!(apart.quat <= smallest_three(0.5f32.sqrt() / 511.0 / 2.0), "{apart:?}");
        assert!(apart.color <= HALF_BYTE / 0.15 * splat_render::sh::C0 + 1e-6, "{apart:?}");
        assert!(apart.opacity <= HALF_BYTE + 1e-6, "{apart:?}");
        assert!(apart.rest <= 1.0 / 256.0 + 1e-6, "{apart:?}");
    }
}

#[test]
fn sog_is_within_its_steps() {
    for degree in 0..=3 {
        let mut file = scene(N, degree);
        file.antialiased = degree % 2 == 0;
        let (loaded, notes) = by_way_of(&folder("sog"), "sog", &file);
        assert_eq!(loaded.format, Format::Sog);
        assert_eq!(loaded.file.antialiased, file.antialiased);
        assert!(notes.is_empty(), "{notes:?}");
        let apart = Apart::of(&file.splats, &loaded.file.splats);
        // 16 bits over -ln 4 to ln 4, and a slope of up to 4.
        assert!(apart.mean <= 4.0 * 2.0 * 4f32.ln() / 65535.0 / 2.0 + 1e-6, "{apart:?}");
        assert!(apart.quat <= smallest_three(2.0f32.sqrt() / 255.0 / 2.0), "{apart:?}");
        assert!(apart.opacity <= HALF_BYTE + 1e-6, "{apart:?}");
        // Of 256 codes, 128 start evenly over the range.
        assert!(apart.scale <= 6.0 / 128.0 / 2.0, "{apart:?}");
        assert!(apart.color <= 3.4 * splat_render::sh::C0 / 128.0 / 2.0, "{apart:?}");
        // Fewer splats than rows of the palette: only the codebook rounds.
        assert!(apart.rest <= 1.0 / 128.0 / 2.0, "{apart:?}");
    }
}

#[test]
fn sog_palettes_find_the_clusters() {
    // 3 000 splats of 40 kinds, in 1 024 rows.
    let mut file = scene(3000, 3);
    let stride = file.splats.stride();
    let kinds = scene(40, 3).splats.sh;
    let noise = 1e-2;
    for (i, row) in file.splats.sh.chunks_exact_mut(stride).enumerate() {
        for k in 1..stride {
            row[k] = std::array::from_fn(|c| kinds[i % 40 * stride + k][c] + noise * row[k][c]);
        }
    }
    let (loaded, _) = by_way_of(&folder("palette"), "sog", &file);
    let apart = Apart::of(&file.splats, &loaded.file.splats);
    // Noise of 0.01 times values of -0.5 to 0.5, and half a step of the codebook.
    assert!(apart.rest <= 2.0 * 0.5 * noise + 1.0 / 256.0, "{apart:?}");
    assert!(apart.rest_rms < 4e-3, "{apart:?}");
}

#[test]
fn gltf_rounds_only_what_it_transforms() {
    for ending in ["glb", "gltf"] {
        for degree in 0..=3 {
            let mut file = scene(N, degree);
            file.origin = [1e6, -0.1, 1.0 / 3.0];
            file.antialiased = true;
            let (loaded, notes) = by_way_of(&folder("gltf"), ending, &file);
            assert_eq!(loaded.format.name(), ending);
            assert_eq!((loaded.file.origin, loaded.file.antialiased), (file.origin, true));
            assert_eq!(notes.len(), 1, "{notes:?}");
            let apart = Apart::of(&file.splats, &loaded.file.splats);
            assert_eq!(apart.mean, 0.0);
            assert_eq!(loaded.file.splats.sh, file.splats.sh);
            assert!(
                apart.quat <= 2e-7 && apart.scale <= 1e-6 && apart.opacity <= 1e-7,
                "{apart:?}"
            );
        }
    }
}

#[test]
fn empty_tiny_and_saturated_scenes_are_written() {
    let folder = folder("few");
    for ending in WRITABLE {
        for n in [0, 1] {
            let file = scene(n, 1);
            if ending == "splat" && n == 0 {
                let error = write_splats(&folder.join("none.splat"), &file).unwrap_err();
                assert!(error.to_string().contains("empty file"), "{error}");
                continue;
            }
            let (loaded, _) = by_way_of(&folder, ending, &file);
            assert_eq!(loaded.file.splats.len(), n, "{ending}");
        }
        let mut file = scene(9, 0);
        for (i, opacity) in file.splats.opacities.iter_mut().enumerate() {
            *opacity = [-1e30, -200.0, -30.0, 30.0, 200.0, 1e30][i % 6];
            file.splats.quats[i] = [0.0, 0.0, 1e-5, -2.0];
            // All in one plane.
            file.splats.means[i][1] = -2.5;
        }
        let (loaded, _) = by_way_of(&folder, ending, &file);
        let apart = Apart::of(&file.splats, &loaded.file.splats);
        assert!(apart.opacity <= HALF_BYTE && apart.quat < 0.011, "{ending}: {apart:?}");
        assert!(loaded.file.splats.opacities.iter().all(|o| o.is_finite()), "{ending}");
    }
}

#[test]
fn the_content_decides_the_format() {
    let folder = folder("content");
    let file = scene(20, 1);
    for (ending, other) in [("spz", "ply"), ("sog", "spz"), ("glb", "splat"), ("ply", "glb")] {
        let (from, to) = (folder.join(format!("a.{ending}")), folder.join(format!("b.{other}")));
        write_splats(&from, &file).unwrap();
        std::fs::rename(&from, &to).unwrap();
        assert_eq!(read_splats(&to).unwrap().format.name(), ending);
    }
}
