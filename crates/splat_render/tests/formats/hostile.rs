//! Truncated files, false claims, and other kinds of files: one message that names the file, and little
//! memory.

use std::path::Path;

use splat_render::io::{parse_splats, read_exr_depth, read_splats};
use splat_render::levels::{INDEX, Manifest};

use crate::layouts::{gzip, ksplat, sog_with, spz_4};
use crate::memory::peak_of;
use crate::scenes::{WRITABLE, bytes_of, folder, scene};

/// Memory limit for small files: the unpacking limit, and the same for copies.
pub const MEMORY_MAX: usize = 160 << 20;

/// The sentence about these bytes.
fn refused(bytes: &[u8], name: &str) -> String {
    let (result, peak) = peak_of(|| parse_splats(bytes, Path::new(name)));
    assert!(peak < MEMORY_MAX, "{name} took {peak} bytes");
    let error = result.expect_err(name).to_string();
    assert!(error.starts_with(name), "{error}");
    assert!(!error.contains('\n') && error.len() < 400, "{error}");
    error
}

#[test]
fn every_truncation_is_one_sentence() {
    let folder = folder("cut");
    let file = scene(3, 1);
    let mut all: Vec<(String, Vec<u8>)> = WRITABLE
        .iter()
        .map(|ending| (format!("cut.{ending}"), bytes_of(&folder, ending, &file)))
        .collect();
    all.push(("cut.ksplat".into(), ksplat(&file, 1)));
    all.push(("four.spz".into(), spz_4(&file.splats)));
    for (name, bytes) in all {
        for length in 0..bytes.len() {
            // A .splat has no header: whole splats of it are a whole file.
            if name != "cut.splat" || length % 32 != 0 || length == 0 {
                refused(&bytes[..length], &name);
            }
        }
        assert!(parse_splats(&bytes, Path::new(&name)).is_ok(), "{name}");
    }
}

#[test]
fn other_files_with_the_ending_splat_are_refused() {
    let jpeg = [&[0xff, 0xd8, 0xff, 0xe0, 0, 16][..], b"JFIF\0", &[7; 200]].concat();
    for ending in WRITABLE.into_iter().chain(["ksplat"]) {
        let name = format!("photo.{ending}");
        assert!(!refused(&jpeg, &name).is_empty());
        assert!(refused(b"", &name).contains("empty"));
        refused(&[b'a'; 10], &name);
        refused(&[0; 10], &name);
        refused(b"{}", &name);
        refused(b"[1, 2]", &name);
        refused(b"PK\x05\x06 a zip of nothing ", &name);
    }
    assert!(refused(&jpeg, "photo.jpg").contains(".spz"));
    assert!(refused(&jpeg, "photo.ply").contains("'ply'"));
    let triangle = br#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],
        "meshes":[{"primitives":[{"attributes":{}}]}]}"#;
    assert!(refused(triangle, "mesh.gltf").contains("no splats"));
}

#[test]
fn four_billion_splats_are_refused_before_memory_is_taken() {
    let folder = folder("claims");
    let file = scene(3, 0);
    let claim = |bytes: &mut [u8], at: usize, count: u32| {
        bytes[at..at + 4].copy_from_slice(&count.to_le_bytes());
    };
    let replaced = |bytes: &[u8], from: &str, to: &str| {
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        [&bytes[..at], to.as_bytes(), &bytes[at + from.len()..]].concat()
    };
    for count in [4_000_000_000u32, 100_000_000, 5_000_000] {
        let ply = bytes_of(&folder, "ply", &file);
        refused(&replaced(&ply, "vertex 3", &format!("vertex {count}")), "a.ply");
        let packed = bytes_of(&folder, "compressed.ply", &file);
        let lie = replaced(&packed, "vertex 3", &format!("vertex {count}"));
        refused(&lie, "a.ply");
        let chunks = count.div_ceil(256);
        refused(&replaced(&lie, "chunk 1", &format!("chunk {chunks}")), "a.ply");

        let mut spz = spz_4(&file.splats);
        claim(&mut spz, 8, count);
        assert!(refused(&spz, "a.spz").contains(&count.to_string()));
        let mut payload = b"NGSP\x03\0\0\0....\x03\x0c\0\0".to_vec();
        claim(&mut payload, 8, count);
        payload.resize(500, 0);
        assert!(refused(&gzip(&payload), "a.spz").contains(&count.to_string()));

        let mut header = ksplat(&file, 1);
        claim(&mut header, 16, count);
        assert!(refused(&header, "a.ksplat").contains(&count.to_string()));
        for at in [0, 4, 8, 12, 32, 36] {
            let mut section = ksplat(&file, 1);
            claim(&mut section, 4096 + at, count);
            // A larger bucket than it is stays a bucket that holds all splats.
            if at != 8 {
                refused(&section, "a.ksplat");
            }
        }
        let mut sections = ksplat(&file, 1);
        claim(&mut sections, 4, count);
        refused(&sections, "a.ksplat");

        let sog = bytes_of(&folder, "sog", &file);
        let meta = |text: String| text.replace("\"count\":3", &format!("\"count\":{count}"));
        assert!(refused(&sog_with(&sog, meta), "a.sog").contains("claims"));
        let gltf = bytes_of(&folder, "gltf", &file);
        refused(&replaced(&gltf, "\"count\":3", &format!("\"count\":{count}")), "a.gltf");
    }
}

#[test]
fn wrong_ply_headers_are_refused() {
    let ply = bytes_of(&folder("header"), "ply", &scene(3, 0));
    let end = ply.windows(10).position(|w| w == b"end_header").unwrap();
    let change = |from: &str, to: &str| {
        let header = String::from_utf8_lossy(&ply[..end]).replace(from, to);
        refused(&[header.as_bytes(), &ply[end..]].concat(), "a.ply")
    };
    assert!(change("vertex 3", "vertex 1000000000").contains("truncated"));
    assert!(change("vertex 3", "vertex -3").contains("-3"));
    assert!(change("binary_little_endian", "ascii").contains("ascii"));
    assert!(change("float opacity", "float opazity").contains("opacity"));
    let none = read_splats(Path::new("none.ply")).unwrap_err().to_string();
    assert!(none.contains("opened"), "{none}");
}

#[test]
fn gigabytes_of_zeros_are_not_unpacked() {
    // 256 MiB behind the header and four splats.
    let mut payload = b"NGSP\x03\0\0\0\x04\0\0\0\0\x0c\0\0".to_vec();
    payload.resize(256 << 20, 0);
    let bytes = gzip(&payload);
    let (result, peak) = peak_of(|| parse_splats(&bytes, Path::new("zeros.spz")));
    assert_eq!(result.unwrap().file.splats.len(), 4);
    assert!(peak < 8 << 20, "{peak}");
}

#[test]
fn json_that_nests_or_points_anywhere_is_refused() {
    let deep = format!("{{\"a\":{}{}}}", "[".repeat(100_000), "]".repeat(100_000));
    refused(deep.as_bytes(), "deep.gltf");
    let nodes = |nodes: &str| {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"extensionsUsed":["KHR_gaussian_splatting"],
            "scenes":[{{"nodes":[0]}}],"nodes":{nodes},"meshes":[]}}"#
        )
    };
    assert!(refused(nodes(r#"[{"children":[0]}]"#).as_bytes(), "loop.gltf").contains("twice"));
    let two = nodes(r#"[{"children":[1,1]},{}]"#);
    assert!(refused(two.as_bytes(), "two.gltf").contains("twice"));
    assert!(refused(nodes(r#"[{"mesh":7}]"#).as_bytes(), "mesh.gltf").contains("meshes[7]"));
    assert!(
        refused(nodes(r#"[{"children":[99999999999]}]"#).as_bytes(), "far.gltf").contains("nodes")
    );
    let skewed = nodes(r#"[{"mesh":0,"scale":[1,2,1]}]"#);
    assert!(refused(skewed.as_bytes(), "skewed.gltf").contains("nodes[0]"));
    for uri in [
        "../secret.bin",
        "/etc/passwd",
        "http://a/b",
        "a/../../b",
        "",
        "file:///b",
        "%2e%2e/b",
        "a%5cb",
    ] {
        let text = format!(
            r#"{{"asset":{{"version":"2.0"}},"buffers":[{{"byteLength":4,"uri":"{uri}"}}]}}"#
        );
        assert!(refused(text.as_bytes(), "uri.gltf").contains("folder"), "{uri}");
    }
}

#[test]
fn json_never_takes_much_memory() {
    let maps = format!("{{\"nodes\":[{}{{}}]}}", "{\"a\":0},".repeat(1_000_000));
    assert!(refused(maps.as_bytes(), "maps.gltf").contains("values"));
    // 20 MB of numbers, deflated to a hundredth.
    let sog = bytes_of(&folder("json"), "sog", &scene(3, 0));
    let numbers = "0,".repeat(10_000_000);
    let sog = sog_with(&sog, |meta| meta.replacen('{', &format!("{{\"a\":[{numbers}0],"), 1));
    assert!(refused(&sog, "numbers.sog").contains("meta.json"));
    // A thousand buffers of one file.
    let folder = folder("shared");
    std::fs::write(folder.join("a.bin"), vec![0; 1 << 20]).unwrap();
    let buffers = vec![r#"{"byteLength":1048576,"uri":"a.bin"}"#; 1000].join(",");
    let text = format!(r#"{{"asset":{{"version":"2.0"}},"buffers":[{buffers}]}}"#);
    let name = folder.join("shared.gltf");
    assert!(refused(text.as_bytes(), name.to_str().unwrap()).contains("no splats"));
    // 60 spellings of one file, 20 MB.
    std::fs::write(folder.join("aaaaaa.bin"), vec![0; 20 << 20]).unwrap();
    let spelled = |k: usize| (0..6).map(move |bit| ["a", "%61"][k >> bit & 1]).collect::<String>();
    let buffer = |k| format!(r#"{{"byteLength":20971520,"uri":"{}.bin"}}"#, spelled(k));
    let buffers: Vec<String> = (0..60).map(buffer).collect();
    let text = format!(r#"{{"asset":{{"version":"2.0"}},"buffers":[{}]}}"#, buffers.join(","));
    assert!(refused(text.as_bytes(), name.to_str().unwrap()).contains("no splats"));
    // 60 hard links to it.
    #[cfg(unix)]
    {
        let link =
            |k| std::fs::hard_link(folder.join("aaaaaa.bin"), folder.join(format!("{k}.bin")));
        (0..60).try_for_each(link).unwrap();
        let buffer = |k| format!(r#"{{"byteLength":20971520,"uri":"{k}.bin"}}"#);
        let buffers: Vec<String> = (0..60).map(buffer).collect();
        let text = format!(r#"{{"asset":{{"version":"2.0"}},"buffers":[{}]}}"#, buffers.join(","));
        assert!(refused(text.as_bytes(), name.to_str().unwrap()).contains("no splats"));
    }
    // An index of levels that is all objects.
    let objects = "{\"\":0},".repeat(5_000_000);
    std::fs::write(folder.join(INDEX), format!("{{\"a\":[{objects}{{}}]}}")).unwrap();
    let (result, peak) = peak_of(|| Manifest::read(&folder));
    let error = result.unwrap_err().to_string();
    assert!(error.contains("values") && peak < MEMORY_MAX, "{error} {peak}");
}

#[test]
fn the_channels_of_an_exr_that_are_not_read_take_no_memory() {
    use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, Image, SmallVec, WritableImage};
    let size = 1000;
    let channel =
        |name: String| AnyChannel::new(name.as_str(), FlatSamples::F32(vec![1.5; size * size]));
    let names = (0..30).map(|k| format!("c{k}")).chain(["Z".to_owned()]);
    let channels: SmallVec<_> = names.map(channel).collect();
    let path = folder("exr").join("many.exr");
    let image = Image::from_channels((size, size), AnyChannels::sort(channels));
    image.write().to_file(&path).unwrap();
    let (read, peak) = peak_of(|| read_exr_depth(&path, size * size));
    assert_eq!(read.unwrap(), (size, size, vec![1.5; size * size]));
    assert!(peak < 16 << 20, "{peak}");
}
