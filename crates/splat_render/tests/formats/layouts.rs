//! Files laid out byte by byte from the formats' descriptions, as other programs write them.

use std::io::{Cursor, Read, Write};
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;
use glam::{DQuat, DVec3};
use half::f16;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};
use serde_json::{Value, json};
use splat_render::fit::SplatArrays;
use splat_render::io::{Loaded, SplatFile, parse_splats};
use splat_render::sh::{self, C0};
use zip::write::SimpleFileOptions;
use zip::{ZipArchive, ZipWriter};

use crate::scenes::{Apart, bytes_of, folder, scene, unit};

fn read(bytes: &[u8], name: &str) -> Loaded {
    parse_splats(bytes, Path::new(name)).unwrap()
}

fn byte(unit: f32) -> u8 {
    (unit * 255.0).round() as u8
}

fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

// ---- .ksplat -----------------------------------------------------------------------------------

/// Splats per full bucket in [`ksplat`].
const BUCKET: usize = 2;

/// A `.ksplat` of one section at a compression level: buckets of two splats, and of one at the end.
pub fn ksplat(file: &SplatFile, level: u16) -> Vec<u8> {
    let splats = &file.splats;
    let (n, stride) = (splats.len(), splats.stride());
    let mut header = vec![0u8; 4096];
    let put = |bytes: &mut [u8], at: usize, value: u32| {
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
    };
    header[1] = 1;
    put(&mut header, 4, 1); // sections reserved
    put(&mut header, 12, n as u32);
    put(&mut header, 16, n as u32);
    header[20] = level as u8;
    put(&mut header, 36, (-1.0f32).to_bits());
    put(&mut header, 40, 1.0f32.to_bits());
    let mut section = vec![0u8; 1024];
    let (full, partial) = (n / BUCKET, n % BUCKET);
    let block = 8.0f32;
    put(&mut section, 0, n as u32);
    put(&mut section, 4, n as u32);
    put(&mut section, 8, BUCKET as u32);
    put(&mut section, 12, (full + partial) as u32);
    put(&mut section, 16, block.to_bits());
    section[20] = 12;
    put(&mut section, 24, 32767);
    put(&mut section, 32, full as u32);
    put(&mut section, 36, partial as u32);
    section[40] = splats.sh_degree as u8;
    let mut out = [header, section].concat();
    for _ in 0..partial {
        out.extend(1u32.to_le_bytes());
    }
    let center = |i: usize| splats.means[i / BUCKET * BUCKET].map(|c| (c * 4.0).round() / 4.0);
    for bucket in 0..full + partial {
        out.extend(center(bucket * BUCKET).into_iter().flat_map(f32::to_le_bytes));
    }
    for i in 0..n {
        let push = |out: &mut Vec<u8>, value: f32| match level {
            0 => out.extend(value.to_le_bytes()),
            _ => out.extend(f16::from_f32(value).to_bits().to_le_bytes()),
        };
        for k in 0..3 {
            match level {
                0 => out.extend(splats.means[i][k].to_le_bytes()),
                _ => {
                    let steps = (splats.means[i][k] - center(i)[k]) / (block / 2.0 / 32767.0);
                    out.extend(((steps + 32767.0).round() as u16).to_le_bytes());
                }
            }
        }
        for scale in splats.scales[i] {
            push(&mut out, scale.exp());
        }
        for component in unit(splats.quats[i]) {
            push(&mut out, component);
        }
        let row = &splats.sh[i * stride..(i + 1) * stride];
        out.extend(row[0].map(|dc| byte(0.5 + C0 as f32 * dc)));
        out.push(byte(sigmoid(splats.opacities[i])));
        for degree in 1..=splats.sh_degree {
            for c in 0..3 {
                for rgb in &row[sh::coeffs(degree - 1)..sh::coeffs(degree)] {
                    match level {
                        2 => out.push(byte((rgb[c] + 1.0) / 2.0)),
                        _ => push(&mut out, rgb[c]),
                    }
                }
            }
        }
    }
    out
}

#[test]
fn ksplat_of_every_level_and_degree() {
    for level in 0..3 {
        for degree in 0..=2 {
            // All within 4 units of the bucket's center.
            let mut file = scene(31, degree);
            for mean in &mut file.splats.means {
                *mean = mean.map(|c| c / 2.0);
            }
            let loaded = read(&ksplat(&file, level), "a.ksplat");
            let apart = Apart::of(&file.splats, &loaded.file.splats);
            let (mean, scale, rest) = match level {
                0 => (0.0, 1e-6, 0.0),
                // Half floats: 11 bits.
                1 => (4.0 / 32767.0 / 2.0 + 1e-6, 5e-4, 2.5e-4),
                _ => (4.0 / 32767.0 / 2.0 + 1e-6, 5e-4, 1.0 / 255.0 + 1e-6),
            };
            let (quat, color, opacity) = (1e-3, 0.5 / 255.0 + 1e-6, 0.5 / 255.0 + 1e-6);
            let most = Apart { mean, scale, quat, opacity, color, rest, ..Apart::default() };
            apart.assert_within(&most, &format!("level {level}, degree {degree}"));
        }
    }
}

// ---- .spz --------------------------------------------------------------------------------------

/// The six arrays of a `.spz`, in its frame, with rotations of version 2 or later.
fn spz_arrays(splats: &SplatArrays, version: u32) -> [Vec<u8>; 6] {
    let stride = splats.stride();
    let mut arrays: [Vec<u8>; 6] = Default::default();
    for i in 0..splats.len() {
        let [x, y, z] = splats.means[i];
        for c in [x, -y, -z] {
            arrays[0].extend(&((c * 4096.0).round() as i32).to_le_bytes()[..3]);
        }
        arrays[1].push(byte(sigmoid(splats.opacities[i])));
        arrays[2].extend(splats.sh[i * stride].map(|dc| byte(0.5 + 0.15 * dc)));
        arrays[3].extend(splats.scales[i].map(|s| ((s + 10.0) * 16.0).round() as u8));
        let [w, x, y, z] = unit(splats.quats[i]);
        let xyzw = [x, -y, -z, w];
        if version == 2 {
            let sign = w.signum();
            arrays[4].extend((0..3).map(|k| (127.5 + 127.5 * sign * xyzw[k]).round() as u8));
        } else {
            let largest = (0..4).max_by(|&a, &b| xyzw[a].abs().total_cmp(&xyzw[b].abs())).unwrap();
            let sign = xyzw[largest].signum();
            let mut packed = largest as u32;
            for k in (0..4).filter(|&k| k != largest) {
                let c = xyzw[k] * sign;
                let magnitude = (511.0 * c.abs() * 2f32.sqrt()).round() as u32;
                packed = packed << 10 | u32::from(c < 0.0) << 9 | magnitude;
            }
            arrays[4].extend(packed.to_le_bytes());
        }
        // Signs of the half turn about x, from the polynomials of the basis.
        let signs = [1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];
        for k in 1..stride {
            let rgb = splats.sh[i * stride + k];
            arrays[5].extend(rgb.map(|c| (128.0 + 128.0 * c * signs[k] as f32).round() as u8));
        }
    }
    arrays
}

fn spz_header(splats: &SplatArrays, version: u32) -> Vec<u8> {
    let mut out = b"NGSP".to_vec();
    out.extend(version.to_le_bytes());
    out.extend((splats.len() as u32).to_le_bytes());
    out.extend([splats.sh_degree as u8, 12, 1, 0]);
    out
}

/// An uncompressed `.spz` of version 2.
pub fn spz_2(splats: &SplatArrays) -> Vec<u8> {
    [spz_header(splats, 2), spz_arrays(splats, 2).concat()].concat()
}

/// A `.spz` of version 4, with a record of an unknown extension.
pub fn spz_4(splats: &SplatArrays) -> Vec<u8> {
    let arrays = spz_arrays(splats, 4);
    let used: Vec<&Vec<u8>> = arrays.iter().filter(|array| !array.is_empty()).collect();
    let extension = [7u32.to_le_bytes(), 3u32.to_le_bytes(), *b"abc."].concat();
    let extension = &extension[..11];
    let mut out = spz_header(splats, 4);
    out[14] |= 2;
    out[15] = used.len() as u8;
    out.extend((32 + extension.len() as u32).to_le_bytes());
    out.extend([0; 12]);
    out.extend(extension);
    let streams: Vec<Vec<u8>> = used
        .iter()
        .map(|array| compress_to_vec(array.as_slice(), CompressionLevel::Fastest))
        .collect();
    for (array, stream) in used.iter().zip(&streams) {
        out.extend((stream.len() as u64).to_le_bytes());
        out.extend((array.len() as u64).to_le_bytes());
    }
    out.extend(streams.concat());
    out
}

pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
    gzip.write_all(bytes).unwrap();
    gzip.finish().unwrap()
}

#[test]
fn spz_of_every_version() {
    for degree in 0..=3 {
        let file = scene(50, degree);
        let two = spz_2(&file.splats);
        let mut three =
            [spz_header(&file.splats, 3), spz_arrays(&file.splats, 3).concat()].concat();
        let mut all = vec![gzip(&two), gzip(&three), spz_4(&file.splats)];
        // Extensions before the arrays and behind them.
        three[14] |= 2;
        let record = [9u32.to_le_bytes(), 4u32.to_le_bytes(), *b"orbi"].concat();
        all.push(gzip(&[&three[..16], &record, &three[16..]].concat()));
        all.push(gzip(&[three.as_slice(), &[1, 2, 3]].concat()));
        for (k, bytes) in all.iter().enumerate() {
            let loaded = read(bytes, "a.spz");
            assert!(loaded.file.antialiased);
            assert_eq!(loaded.notes.len(), usize::from(k >= 2));
            let apart = Apart::of(&file.splats, &loaded.file.splats);
            let most = Apart {
                mean: 0.5 / 4096.0 + 1e-6,
                // Version 2's w has a larger error if it is small.
                quat: if k == 0 { 0.15 } else { 2.5e-3 },
                scale: 1.0 / 32.0 + 1e-6,
                opacity: 0.002,
                color: 0.0037,
                rest: 1.0 / 256.0 + 1e-6,
                ..Apart::default()
            };
            apart.assert_within(&most, &format!("file {k}"));
        }
    }
}

// ---- .sog --------------------------------------------------------------------------------------

/// Names and contents of a zip.
pub type Entries = Vec<(String, Vec<u8>)>;

/// Names and contents of a `.sog`.
pub fn sog_entries(bytes: &[u8]) -> Entries {
    let mut zip = ZipArchive::new(Cursor::new(bytes)).unwrap();
    (0..zip.len())
        .map(|k| {
            let mut entry = zip.by_index(k).unwrap();
            let mut bytes = Vec::new();
            entry.read_to_end(&mut bytes).unwrap();
            (entry.name().unwrap().into_owned(), bytes)
        })
        .collect()
}

/// A `.sog` of these.
pub fn sog_of(entries: &Entries) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        zip.start_file(name, SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// A `.sog` whose meta.json is changed.
pub fn sog_with(bytes: &[u8], change: impl Fn(String) -> String) -> Vec<u8> {
    let mut entries = sog_entries(bytes);
    for (name, bytes) in &mut entries {
        if name == "meta.json" {
            *bytes = change(String::from_utf8(bytes.clone()).unwrap()).into_bytes();
        }
    }
    sog_of(&entries)
}

#[test]
fn sog_as_others_write_it() {
    let file = scene(60, 3);
    let bytes = bytes_of(&folder("sog-others"), "sog", &file);
    let plain = read(&bytes, "a.sog");
    // Deflated entries (as `sog_of` writes them), labels before centroids, and without the flag.
    let other = sog_with(&bytes, |meta| {
        let mut meta: Value = serde_json::from_str(&meta).unwrap();
        meta["shN"]["files"].as_array_mut().unwrap().reverse();
        meta.as_object_mut().unwrap().remove("antialias");
        meta.to_string()
    });
    assert_eq!(read(&other, "a.sog"), plain);
    let refused = |from: &str, to: &str| {
        let bytes = sog_with(&bytes, |meta| {
            assert!(meta.contains(from), "{meta}");
            meta.replace(from, to)
        });
        parse_splats(&bytes, Path::new("a.sog")).unwrap_err().to_string()
    };
    assert!(refused("\"version\":2", "\"version\":3").contains("version"));
    assert!(refused("\"version\":2", "\"v\":2").contains("version 1"));
    assert!(refused("quats.webp", "quat.webp").contains("quat.webp"));
    assert!(refused("\"bands\":3", "\"bands\":2").contains("damaged"));
}

// ---- glTF --------------------------------------------------------------------------------------

/// Arrays of a glTF, as other programs write them.
#[derive(Default)]
struct Gltf {
    binary: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Gltf {
    /// Adds an array of rows, `gap` bytes apart if given; returns the number of its accessor.
    fn push(&mut self, code: u32, width: usize, gap: Option<usize>, rows: Vec<Vec<u8>>) -> Value {
        let start = self.binary.len();
        for row in &rows {
            self.binary.extend(row);
            self.binary.resize(self.binary.len() + gap.map_or(0, |gap| gap - row.len()), 0xee);
        }
        let mut view = json!({ "buffer": 0, "byteOffset": start,
            "byteLength": self.binary.len() - start });
        if let Some(gap) = gap {
            view["byteStride"] = json!(gap);
        }
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1];
        self.accessors.push(json!({ "bufferView": self.views.len(), "componentType": code,
            "count": rows.len(), "type": kind,
            "normalized": code != 5126 }));
        self.views.push(view);
        json!(self.accessors.len() - 1)
    }

    /// Adds splats; returns the attributes. Quantized: interleaved rows of 32 bytes, and integers for
    /// quats and opacities.
    fn splats(&mut self, splats: &SplatArrays, quantized: bool) -> Value {
        let gap = quantized.then_some(32);
        let floats = |row: &[f32]| row.iter().flat_map(|c| c.to_le_bytes()).collect::<Vec<u8>>();
        let key = |name: &str| format!("KHR_gaussian_splatting:{name}");
        let mut names = serde_json::Map::new();
        let means = splats.means.iter().map(|m| floats(m)).collect();
        names.insert("POSITION".into(), self.push(5126, 3, gap, means));
        let quats = splats.quats.iter().map(|&q| {
            let [w, x, y, z] = unit(q);
            [x, y, z, w]
        });
        let opacities = splats.opacities.iter().map(|&o| sigmoid(o));
        let [quats, opacities] = if quantized {
            let short = |c: f32| ((c * 32767.0).round() as i16).to_le_bytes();
            let quats = quats.map(|q| q.into_iter().flat_map(short).collect()).collect();
            let opacities = opacities.map(|o| vec![byte(o)]).collect();
            [self.push(5122, 4, gap, quats), self.push(5121, 1, gap, opacities)]
        } else {
            let quats = quats.map(|q| floats(&q)).collect();
            let opacities = opacities.map(|o| floats(&[o])).collect();
            [self.push(5126, 4, gap, quats), self.push(5126, 1, gap, opacities)]
        };
        names.insert(key("ROTATION"), quats);
        names.insert(key("OPACITY"), opacities);
        let scales = splats.scales.iter().map(|s| floats(&s.map(f32::exp))).collect();
        names.insert(key("SCALE"), self.push(5126, 3, gap, scales));
        for degree in 0..=splats.sh_degree {
            let start = if degree == 0 { 0 } else { sh::coeffs(degree - 1) };
            for k in start..sh::coeffs(degree) {
                let rows = splats.sh.iter().skip(k).step_by(splats.stride());
                let rows = rows.map(|rgb| floats(rgb)).collect();
                let name = key(&format!("SH_DEGREE_{degree}_COEF_{}", k - start));
                names.insert(name, self.push(5126, 3, gap, rows));
            }
        }
        names.into()
    }
}

/// Two meshes: the first quantized, and moved, turned and scaled by its node and the node's parent; the
/// second of SH degree 0.
#[test]
fn gltf_as_others_write_it() {
    let (one, two) = (scene(12, 2).splats, scene(5, 0).splats);
    let mut arrays = Gltf::default();
    let attributes = [arrays.splats(&one, true), arrays.splats(&two, false)];
    let Gltf { binary, views, accessors } = arrays;
    let turn = DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.7);
    let far = 1e6 + 0.125;
    let primitive = |k: usize| {
        json!({ "mode": 0, "attributes": attributes[k],
        "extensions": { "KHR_gaussian_splatting": { "kernel": "ellipse",
        "colorSpace": "lin_rec709_display" } } })
    };
    let document = json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0, 2] }],
        "nodes": [
            { "translation": [far, 0.0, -3.0], "children": [1] },
            { "mesh": 0, "rotation": turn.to_array(), "scale": [2.0, 2.0, 2.0] },
            { "mesh": 1 },
        ],
        "meshes": [{ "primitives": [primitive(0), { "attributes": {} }] },
            { "primitives": [primitive(1)] }],
        "accessors": accessors, "bufferViews": views,
        "buffers": [{ "byteLength": binary.len(), "uri": "scene%20data.bin" }],
    });
    let folder = folder("gltf-others");
    std::fs::write(folder.join("scene data.bin"), &binary).unwrap();
    let path = folder.join("scene.gltf");
    std::fs::write(&path, document.to_string()).unwrap();
    let loaded = splat_render::io::read_splats(&path).unwrap();

    assert_eq!(loaded.notes.len(), 2, "{:?}", loaded.notes);
    let after = &loaded.file.splats;
    assert_eq!((after.len(), after.sh_degree), (17, 2));
    let half_turn = |v: DVec3| DVec3::new(v.x, -v.y, -v.z);
    let seen = |row: &[[f32; 3]], degree: u32, dir: DVec3| -> f64 {
        let basis = sh::basis::<f64>(degree, dir.to_array());
        row.iter().zip(basis).map(|(rgb, b)| f64::from(rgb[1]) * b).sum()
    };
    for i in 0..17 {
        let (from, at, turn, scale, shift) = if i < 12 {
            (&one, i, turn, 2.0, DVec3::new(far, 0.0, -3.0))
        } else {
            (&two, i - 12, DQuat::IDENTITY, 1.0, DVec3::ZERO)
        };
        let mean = DVec3::from_array(from.means[at].map(f64::from));
        let world = half_turn(turn * (mean * scale) + shift);
        let ours = DVec3::from_array(after.means[i].map(f64::from))
            + DVec3::from_array(loaded.file.origin);
        // The second mesh is a million units from the origin.
        assert!((world - ours).abs().max_element() < if i < 12 { 1e-5 } else { 0.1 }, "{i}");
        // The long axis of each splat.
        let axis = |q: [f32; 4]| {
            let [w, x, y, z] = unit(q).map(f64::from);
            DQuat::from_xyzw(x, y, z, w) * DVec3::X
        };
        let long = half_turn(turn * axis(from.quats[at]));
        let along = long.dot(axis(after.quats[i])).abs();
        assert!(along > 1.0 - 1e-6, "{i}: {along}");
        for k in 0..3 {
            let scaled = from.scales[at][k] + (scale as f32).ln();
            assert!((scaled - after.scales[i][k]).abs() < 1e-5);
        }
        assert!((sigmoid(from.opacities[at]) - sigmoid(after.opacities[i])).abs() < 0.002);
        for dir in [DVec3::Y, DVec3::new(0.48, -0.6, 0.64)] {
            let stride = from.stride();
            let was = seen(&from.sh[at * stride..(at + 1) * stride], from.sh_degree, dir);
            let is = seen(&after.sh[i * 9..(i + 1) * 9], 2, half_turn(turn * dir));
            assert!((was - is).abs() < 1e-5, "{i}: {was} became {is}");
        }
    }
}
