//! `meta.json`: the names of the images and the scales of their bytes.

use serde_json::{Value, json};

use super::{CODES, SH_DEGREE};
use crate::error::Result;
use crate::io::bytes::Named;

pub struct Meta {
    pub count: u64,
    pub antialiased: bool,
    /// Bounds of the positions' signed logarithms.
    pub low: [f64; 3],
    /// The upper bound.
    pub high: [f64; 3],
    /// Images of the positions' low and high bytes.
    pub means: [String; 2],
    /// Log-scales by code, and their image.
    pub scales: Coded,
    /// Image of the rotations.
    pub quats: String,
    /// DC coefficients by code, and their image.
    pub sh0: Coded,
    /// Higher SH, if any.
    pub rest: Option<Rest>,
}

/// Values by code, and the image of codes.
pub struct Coded {
    pub codebook: Vec<f32>,
    pub image: String,
}

pub struct Rest {
    /// Rows of the palette.
    pub count: usize,
    pub degree: u32,
    /// Coefficients by code.
    pub codebook: Vec<f32>,
    /// Image of the palette.
    pub centroids: String,
    /// Image of each splat's row in it.
    pub labels: String,
}

impl Meta {
    pub fn read(text: &[u8], named: &Named<'_>) -> Result<Self> {
        let meta: Value = serde_json::from_slice(text)
            .map_err(|e| named.bad(format!("has a meta.json that is not JSON ({e})")))?;
        let missing = |what: &str| {
            named.bad(format!("has no valid '{what}' in its meta.json; export it again"))
        };
        match meta.get("version").map(Value::as_u64) {
            Some(Some(2)) => {}
            Some(_) => {
                return Err(named.bad("is a .sog of a version other than 2; export it again"));
            }
            None => {
                return Err(named.bad(
                    "is a .sog of version 1; export it again as version 2, for example with \
                     SuperSplat",
                ));
            }
        }
        let rest = match meta.get("shN") {
            None | Some(Value::Null) => None,
            Some(rest) => {
                let [a, b] = files(rest).ok_or_else(|| missing("shN.files"))?;
                // Writers disagree about the order.
                let (centroids, labels) = if b.contains("centroids") { (b, a) } else { (a, b) };
                let degree = rest.get("bands").and_then(Value::as_u64);
                let degree = degree.filter(|d| (1..=u64::from(SH_DEGREE)).contains(d));
                let count = rest.get("count").and_then(Value::as_u64);
                let count = count.filter(|&count| count <= 1 << 16);
                Some(Rest {
                    count: count.ok_or_else(|| missing("shN.count"))? as usize,
                    degree: degree.ok_or_else(|| missing("shN.bands"))? as u32,
                    codebook: codebook(rest).ok_or_else(|| missing("shN.codebook"))?,
                    centroids,
                    labels,
                })
            }
        };
        let coded = |key: &str| -> Option<Coded> {
            let part = meta.get(key)?;
            let [image] = files(part)?;
            Some(Coded { codebook: codebook(part)?, image })
        };
        let bounds = |key: &str| numbers::<3>(meta.get("means")?.get(key)?);
        let [quats] = meta.get("quats").and_then(files).ok_or_else(|| missing("quats.files"))?;
        Ok(Self {
            count: meta.get("count").and_then(Value::as_u64).ok_or_else(|| missing("count"))?,
            // The second is GaussForge's.
            antialiased: meta.get("antialias").and_then(Value::as_bool).unwrap_or(false)
                || meta.get("model").and_then(Value::as_str) == Some("antialiased"),
            low: bounds("mins").ok_or_else(|| missing("means.mins"))?,
            high: bounds("maxs").ok_or_else(|| missing("means.maxs"))?,
            means: meta.get("means").and_then(files).ok_or_else(|| missing("means.files"))?,
            scales: coded("scales").ok_or_else(|| missing("scales"))?,
            quats,
            sh0: coded("sh0").ok_or_else(|| missing("sh0"))?,
            rest,
        })
    }

    pub fn files(&self) -> impl Iterator<Item = &str> {
        let rest = self.rest.iter().flat_map(|rest| [&rest.centroids, &rest.labels]);
        let others = [&self.scales.image, &self.quats, &self.sh0.image];
        self.means.iter().chain(others).chain(rest).map(String::as_str)
    }

    pub fn write(&self) -> String {
        let coded = |part: &Coded| json!({ "codebook": part.codebook, "files": [part.image] });
        let mut meta = json!({
            "version": 2,
            "asset": { "generator": concat!("igsr ", env!("CARGO_PKG_VERSION")) },
            "count": self.count,
            "antialias": self.antialiased,
            "means": { "mins": self.low, "maxs": self.high, "files": self.means },
            "scales": coded(&self.scales),
            "quats": { "files": [self.quats] },
            "sh0": coded(&self.sh0),
        });
        if let Some(rest) = &self.rest {
            meta["shN"] = json!({
                "count": rest.count,
                "bands": rest.degree,
                "codebook": rest.codebook,
                "files": [rest.centroids, rest.labels],
            });
        }
        meta.to_string()
    }
}

fn numbers<const N: usize>(value: &Value) -> Option<[f64; N]> {
    let values: Option<Vec<f64>> = value.as_array()?.iter().map(Value::as_f64).collect();
    values?.try_into().ok()
}

fn files<const N: usize>(part: &Value) -> Option<[String; N]> {
    let names = part.get("files")?.as_array()?;
    let names: Option<Vec<String>> = names.iter().map(|v| v.as_str().map(str::to_owned)).collect();
    names?.try_into().ok()
}

fn codebook(part: &Value) -> Option<Vec<f32>> {
    let values = numbers::<CODES>(part.get("codebook")?)?;
    Some(values.map(|value| value as f32).into())
}
