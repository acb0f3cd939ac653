//! Round trips are within the steps of the format's numbers.

use splat_render::io::{Format, read_splats, write_splats};
use splat_render::sh::C0;

use crate::scenes::{Apart, WRITABLE, by_way_of, folder, scene};

const N: usize = 700;
/// Half a step of a byte.
const HALF_BYTE: f64 = 0.5 / 255.0;

/// The largest error of a quaternion whose three smallest components are off by `e`: the largest
/// component, at least 1/2, is then off by 3 e.
fn smallest_three(e: f64) -> f64 {
    12f64.sqrt() * e
}

#[test]
fn each_format_is_within_its_steps() {
    let none = Apart::default;
    let byte = HALF_BYTE + 1e-6;
    let gltf = || Apart { quat: 2e-7, scale: 1e-6, opacity: 1e-7, ..none() };
    // At least 10 bits over a chunk, whose size is at most the scene's.
    let chunk = 6.0 / 1023.0 / 2.0 + 1e-6;
    let compressed = Apart {
        mean: chunk,
        scale: chunk,
        quat: smallest_three(2f64.sqrt() / 1023.0 / 2.0),
        opacity: byte,
        color: byte,
        rest: 8.0 / 256.0 / 2.0 + 1e-6,
        ..none()
    };
    // Half a step of 1/128, and a whole one for a component of 1, which has no byte.
    let splat = Apart { scale: 2e-6, quat: 0.0104, opacity: byte, color: byte, ..none() };
    let spz = Apart {
        // 24 bits over -4 to 4.
        mean: (-22f64).exp2(),
        scale: 1.0 / 32.0 + 1e-6,
        quat: smallest_three(0.5f64.sqrt() / 511.0 / 2.0),
        opacity: byte,
        color: HALF_BYTE / 0.15 * C0 + 1e-6,
        rest: 1.0 / 256.0 + 1e-6,
        ..none()
    };
    let sog = Apart {
        // 16 bits over -ln 4 to ln 4, and a slope of up to 4.
        mean: 4.0 * 2.0 * 4f64.ln() / 65535.0 / 2.0 + 1e-6,
        // Of 256 codes, 128 start evenly over the range.
        scale: 6.0 / 128.0 / 2.0,
        quat: smallest_three(2f64.sqrt() / 255.0 / 2.0),
        opacity: byte,
        color: 3.4 * C0 / 128.0 / 2.0,
        // Fewer splats than rows of the palette: only the codebook rounds.
        rest: 1.0 / 128.0 / 2.0,
        ..none()
    };
    // Format, ending, highest degree, and whether it stores the origin.
    let cases = [
        (Format::Ply, "ply", 4, true, none()),
        (Format::CompressedPly, "compressed.ply", 3, true, compressed),
        (Format::Splat, "splat", 0, false, splat),
        (Format::Spz, "spz", 4, false, spz),
        (Format::Sog, "sog", 3, false, sog),
        (Format::Glb, "glb", 3, true, gltf()),
        (Format::Gltf, "gltf", 3, true, gltf()),
    ];
    for (format, ending, degrees, has_origin, most) in cases {
        for degree in 0..=degrees {
            let mut file = scene(N, degree);
            file.origin = if has_origin { [1e6, -0.1, 1.0 / 3.0] } else { [0.0; 3] };
            file.antialiased = format != Format::Splat && degree % 2 == 0;
            let (loaded, notes) = by_way_of(&folder("steps"), ending, &file);
            assert_eq!(loaded.format, format);
            assert_eq!(loaded.file.origin, file.origin, "{ending}");
            assert_eq!(loaded.file.antialiased, file.antialiased, "{ending}");
            let noted = match format {
                Format::Spz => degree == 4,
                Format::Glb | Format::Gltf => file.antialiased,
                _ => false,
            };
            assert_eq!(notes.len(), usize::from(noted), "{ending}: {notes:?}");
            let apart = Apart::of(&file.splats, &loaded.file.splats);
            apart.assert_within(&most, &format!("{ending}, degree {degree}"));
            match format {
                Format::Ply => assert!(loaded.file == file && loaded.notes.is_empty()),
                Format::CompressedPly => assert_eq!(degree > 0, apart.rest > 0.0),
                Format::Glb | Format::Gltf => assert_eq!(loaded.file.splats.sh, file.splats.sh),
                _ => {}
            }
        }
    }
}

#[test]
fn sog_palettes_find_the_clusters() {
    // 3 000 splats of 40 kinds, in 1 024 rows.
    let mut file = scene(3000, 3);
    let stride = file.splats.stride();
    let kinds = scene(40, 3).splats.sh;
    let noise = 1e-2f32;
    for (i, row) in file.splats.sh.chunks_exact_mut(stride).enumerate() {
        for k in 1..stride {
            row[k] = std::array::from_fn(|c| kinds[i % 40 * stride + k][c] + noise * row[k][c]);
        }
    }
    let (loaded, _) = by_way_of(&folder("palette"), "sog", &file);
    let apart = Apart::of(&file.splats, &loaded.file.splats);
    // Noise of 0.01 times values of -0.5 to 0.5, and half a step of the codebook.
    assert!(apart.rest <= 2.0 * 0.5 * f64::from(noise) + 1.0 / 256.0, "{apart:?}");
    assert!(apart.rest_rms < 4e-3, "{apart:?}");
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
