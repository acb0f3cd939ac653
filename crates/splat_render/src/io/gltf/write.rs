//! Writing glTF.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Map, Value, json};

use super::{
    ANTIALIASED, CHUNK_BINARY, CHUNK_JSON, COLOR_SPACE, EXTENSION, FLOAT, KERNEL, MAGIC, OPACITY,
    ROTATION, SCALE, SH_DEGREE, TEXT_MAX, sh_name,
};
use crate::error::Result;
use crate::io::frame;
use crate::io::prepare::{Room, prepare, unfit};
use crate::io::quantize::{sigmoid, to_f32, to_f64};
use crate::io::splat::linear_scale;
use crate::io::{Format, SplatFile};
use crate::sh;
use crate::splats::SplatArrays;

const ROOM: Room =
    Room { name: "glTF file", sh_degree: SH_DEGREE, origin: true, antialiased: true };

/// The attributes of a primitive, and the bytes behind them.
#[derive(Default)]
struct Attributes {
    names: Map<String, Value>,
    accessors: Vec<Value>,
    views: Vec<Value>,
    bytes: Vec<u8>,
}

impl Attributes {
    fn push<const N: usize>(&mut self, name: &str, rows: impl Iterator<Item = [f32; N]>) {
        let start = self.bytes.len();
        for value in rows.flatten() {
            self.bytes.extend(value.to_le_bytes());
        }
        let length = self.bytes.len() - start;
        self.names.insert(name.to_owned(), json!(self.accessors.len()));
        self.accessors.push(json!({
            "bufferView": self.views.len(),
            "componentType": FLOAT,
            "count": length / (4 * N),
            "type": if N == 1 { "SCALAR".to_owned() } else { format!("VEC{N}") },
        }));
        self.views.push(json!({ "buffer": 0, "byteOffset": start, "byteLength": length }));
    }

    fn of(splats: &SplatArrays) -> Self {
        let mut all = Self::default();
        all.push("POSITION", splats.means.iter().copied());
        // glTF wants the bounds of positions.
        let bound = |start: f32, pick: fn(f32, f32) -> f32| -> [f32; 3] {
            std::array::from_fn(|k| splats.means.iter().fold(start, |b, mean| pick(b, mean[k])))
        };
        all.accessors[0]["min"] = json!(bound(f32::INFINITY, f32::min));
        all.accessors[0]["max"] = json!(bound(f32::NEG_INFINITY, f32::max));
        let unit = |quat: &[f32; 4]| {
            let [w, x, y, z] = to_f64(*quat);
            let norm = (w * w + x * x + y * y + z * z).sqrt();
            to_f32([x, y, z, w].map(|c| c / norm))
        };
        all.push(ROTATION, splats.quats.iter().map(unit));
        all.push(SCALE, splats.scales.iter().map(|scale| scale.map(linear_scale)));
        all.push(OPACITY, splats.opacities.iter().map(|&logit| [sigmoid(logit) as f32]));
        let stride = splats.stride();
        for degree in 0..=splats.sh_degree {
            let start = if degree == 0 { 0 } else { sh::coeffs(degree - 1) };
            for k in start..sh::coeffs(degree) {
                let rows = splats.sh.iter().skip(k).step_by(stride).copied();
                all.push(&sh_name(degree, k - start), rows);
            }
        }
        all
    }
}

pub fn encode(file: &SplatFile, format: Format, notes: &mut Vec<String>) -> Result<Vec<u8>> {
    let mut splats = prepare(file, &ROOM, notes).into_owned();
    frame::turn(&mut splats);
    if file.antialiased {
        notes.push("glTF has no place for the antialiased flag: only igsr reads it.".to_owned());
    }
    let mut document = json!({
        "asset": { "version": "2.0", "generator": concat!("igsr ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{}],
    });
    let mut bytes = Vec::new();
    // glTF allows no empty lists: a scene without splats has no mesh.
    if !splats.is_empty() {
        let attributes = Attributes::of(&splats);
        bytes = attributes.bytes;
        let mut primitive = json!({
            "mode": 0,
            "attributes": attributes.names,
            "extensions": { EXTENSION: {
                "kernel": KERNEL,
                "colorSpace": COLOR_SPACE,
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            } },
        });
        if file.antialiased {
            primitive["extras"] = json!({ ANTIALIASED: true });
        }
        let mut node = json!({ "mesh": 0 });
        if file.origin != [0.0; 3] {
            node["translation"] = json!(frame::turn_point(file.origin));
        }
        document["scenes"] = json!([{ "nodes": [0] }]);
        document["nodes"] = json!([node]);
        document["meshes"] = json!([{ "primitives": [primitive] }]);
        document["accessors"] = Value::Array(attributes.accessors);
        document["bufferViews"] = Value::Array(attributes.views);
        document["buffers"] = json!([{ "byteLength": bytes.len() }]);
    }
    if format == Format::Glb { glb(&document, bytes) } else { gltf(document, &bytes) }
}

fn glb(document: &Value, mut binary: Vec<u8>) -> Result<Vec<u8>> {
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    binary.resize(binary.len().next_multiple_of(4), 0);
    let chunks: &[(&[u8; 4], &[u8])] = if binary.is_empty() {
        &[(CHUNK_JSON, &text)]
    } else {
        &[(CHUNK_JSON, &text), (CHUNK_BINARY, &binary)]
    };
    let length = 12 + chunks.iter().map(|(_, chunk)| 8 + chunk.len()).sum::<usize>();
    let length = u32::try_from(length).map_err(|_| unfit("a .glb holds at most 4 GiB"))?;
    let mut out = Vec::with_capacity(length as usize);
    out.extend(MAGIC);
    out.extend(2u32.to_le_bytes());
    out.extend(length.to_le_bytes());
    for (kind, chunk) in chunks {
        // Shorter than `length`, which fits.
        out.extend((chunk.len() as u32).to_le_bytes());
        out.extend(*kind);
        out.extend(*chunk);
    }
    Ok(out)
}

fn gltf(mut document: Value, binary: &[u8]) -> Result<Vec<u8>> {
    if binary.len() > TEXT_MAX / 2 {
        return Err(unfit("a .gltf of this size would be too large to read; write a .glb"));
    }
    if !binary.is_empty() {
        let data = STANDARD.encode(binary);
        document["buffers"][0]["uri"] =
            json!(format!("data:application/octet-stream;base64,{data}"));
    }
    Ok(document.to_string().into_bytes())
}
