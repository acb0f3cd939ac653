//! The JSON and the buffers of a glTF file.

use std::borrow::Cow;
use std::collections::HashMap;
use std::path::{Component, Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;

use super::{CHUNK_BINARY, CHUNK_JSON, EXTENSION, MAGIC, TEXT_MAX};
use crate::error::{Error, Result};
use crate::io::bytes::{Bytes, Named, u32_at};
use crate::io::{Format, limits, open_file};

/// Most values in the JSON; splats take a few hundred.
const VALUES_MAX: usize = 1 << 18;

/// A file's JSON and buffers.
pub struct Document<'a> {
    pub json: Value,
    /// Place in `stores` of each buffer's bytes.
    buffers: Vec<usize>,
    stores: Vec<Cow<'a, [u8]>>,
    named: Named<'a>,
}

impl<'a> Document<'a> {
    /// Opens the file in `bytes`.
    pub fn open(bytes: &'a [u8], format: Format, named: &Named<'a>) -> Result<Self> {
        let (text, binary) =
            if format == Format::Glb { split_glb(bytes, named)? } else { (bytes, None) };
        let alone = "write its splats alone, as .glb";
        if text.len() > TEXT_MAX {
            return Err(named.bad(format!("has more than {TEXT_MAX} bytes of JSON; {alone}")));
        }
        let json = limits::parse_json(text, VALUES_MAX)
            .map_err(|reason| named.bad(format!("{reason}; {alone}")))?;
        let mut document = Self { json, buffers: Vec::new(), stores: Vec::new(), named: *named };
        let names =
            |value: &Value| value.as_str().filter(|&name| name != EXTENSION).map(String::from);
        if let Some(name) = document.list("extensionsRequired").iter().find_map(names) {
            return Err(named.bad(format!(
                "requires {name}, which igsr cannot read; save it without, or as .ply"
            )));
        }
        let mut files = HashMap::new();
        for k in 0..document.list("buffers").len() {
            let store = document.buffer(k, binary, &mut files)?;
            document.buffers.push(store);
        }
        Ok(document)
    }

    /// Bytes of all buffers, to check counts of splats against.
    pub fn size(&self) -> usize {
        self.stores.iter().map(|store| store.len()).sum()
    }

    pub fn bad(&self, reason: impl Into<String>) -> crate::Error {
        self.named.bad(reason)
    }

    /// The list `key` of the JSON; empty if there is none.
    pub fn list(&self, key: &str) -> &[Value] {
        self.json.get(key).and_then(Value::as_array).map_or(&[], Vec::as_slice)
    }

    /// Item `index` of the list `key`.
    pub fn item(&self, key: &str, index: usize) -> Result<&Value> {
        self.list(key)
            .get(index)
            .ok_or_else(|| self.bad(format!("refers to {key}[{index}], which it does not have")))
    }

    /// The bytes of a buffer view, and its stride if it gives one.
    pub fn view(&self, index: usize) -> Result<(&[u8], Option<usize>)> {
        let view = self.item("bufferViews", index)?;
        let store = number(view, "buffer").and_then(|k| self.stores.get(*self.buffers.get(k)?));
        let start = number(view, "byteOffset").unwrap_or(0);
        let bytes = store
            .zip(number(view, "byteLength"))
            .and_then(|(store, length)| store.get(start..)?.get(..length))
            .ok_or_else(|| {
                self.bad(format!("has bufferViews[{index}] outside its buffer; it is truncated"))
            })?;
        Ok((bytes, number(view, "byteStride")))
    }

    /// The index in `stores` of buffer `k`'s bytes; `files` caches other files' indices.
    fn buffer(
        &mut self,
        k: usize,
        binary: Option<&'a [u8]>,
        files: &mut HashMap<PathBuf, usize>,
    ) -> Result<usize> {
        let buffer = self.item("buffers", k)?;
        let length = number(buffer, "byteLength")
            .ok_or_else(|| self.bad(format!("has buffers[{k}] without a byteLength")))?;
        let uri = buffer.get("uri").and_then(Value::as_str);
        let inline = uri.and_then(|uri| uri.split_once(";base64,"));
        let next = self.stores.len();
        let (place, bytes) = match (uri, inline, binary) {
            (_, Some((kind, data)), _) if kind.starts_with("data:") => {
                let bytes = STANDARD
                    .decode(data)
                    .map_err(|e| self.bad(format!("has buffers[{k}] that is not base64 ({e})")))?;
                (next, Some(Cow::Owned(bytes)))
            }
            (Some(uri), _, _) => {
                // One file may have many spellings and links.
                let path = self.neighbor(uri)?;
                let key = identity(&path);
                match files.get(&key) {
                    Some(&place) => (place, None),
                    None => {
                        let read = self.read(&path, uri)?;
                        files.insert(key, next);
                        (next, Some(Cow::Owned(read)))
                    }
                }
            }
            (None, _, Some(binary)) if k == 0 => (next, Some(Cow::Borrowed(binary))),
            _ => return Err(self.bad(format!("has buffers[{k}] without any bytes"))),
        };
        self.stores.extend(bytes);
        let found = self.stores[place].len();
        if found < length {
            return Err(self.bad(format!(
                "has buffers[{k}] of {found} bytes instead of {length}; it is truncated"
            )));
        }
        Ok(place)
    }

    /// The path of a file in the same folder or below it.
    fn neighbor(&self, uri: &str) -> Result<PathBuf> {
        let name = percent_decoded(uri);
        let plain = Path::new(&name).components().all(|part| matches!(part, Component::Normal(_)));
        if name.contains([':', '\\', '\0']) || name.is_empty() || !plain {
            let shown = beginning(uri);
            return Err(self.bad(format!(
                "refers to {shown:?}; only files in its own folder are opened: write a .glb instead"
            )));
        }
        Ok(self.named.0.with_file_name(name))
    }

    fn read(&self, path: &Path, uri: &str) -> Result<Vec<u8>> {
        use std::io::Read;
        let refers = |to: &str| self.bad(format!("refers to {:?}, which {to}", beginning(uri)));
        let file = open_file(path).map_err(|error| match error {
            Error::File { reason, .. } => refers(&reason),
            error => error,
        })?;
        let mut bytes = Vec::new();
        file.take(limits::FILE_MAX.saturating_sub(self.size() as u64))
            .read_to_end(&mut bytes)
            .map_err(|e| refers(&format!("cannot be read ({e})")))?;
        Ok(bytes)
    }
}

/// A key that all names of a file share: on unix its device and number, which hard links share too.
fn identity(path: &Path) -> PathBuf {
    #[cfg(unix)]
    let found = path.metadata().map(|file| {
        use std::os::unix::fs::MetadataExt;
        PathBuf::from(format!("{}/{}", file.dev(), file.ino()))
    });
    #[cfg(not(unix))]
    let found = path.canonicalize();
    found.unwrap_or_else(|_| path.to_owned())
}

fn split_glb<'a>(bytes: &'a [u8], named: &Named<'a>) -> Result<(&'a [u8], Option<&'a [u8]>)> {
    let mut rest = Bytes::new(bytes, named);
    let header = rest.take(12, "header")?;
    if !header.starts_with(MAGIC) || u32_at(header, 4) != 2 {
        return Err(named.bad("is no .glb of version 2; export it again"));
    }
    let (mut json, mut binary) = (None, None);
    while rest.len() >= 8 {
        let head = rest.take(8, "chunks")?;
        let chunk = rest.take(u32_at(head, 0) as usize, "chunks")?;
        let kind = &head[4..8];
        if kind == CHUNK_JSON {
            json.get_or_insert(chunk);
        } else if kind == CHUNK_BINARY {
            binary.get_or_insert(chunk);
        }
    }
    Ok((json.ok_or_else(|| named.bad("has no JSON in it; it is truncated"))?, binary))
}

/// The beginning of a URI, which may be a damaged data: URI of many MB.
fn beginning(uri: &str) -> String {
    uri.chars().take(80).collect()
}

/// The count or index `key` of an object.
pub fn number(object: &Value, key: &str) -> Option<usize> {
    usize::try_from(object.get(key)?.as_u64()?).ok()
}

/// A URI's text with its %XX as the bytes that they stand for.
fn percent_decoded(uri: &str) -> String {
    let hex = |byte: u8| char::from(byte).to_digit(16);
    let mut out = Vec::new();
    let mut rest = uri.as_bytes();
    while let [first, others @ ..] = rest {
        rest = others;
        if let (b'%', [high, low, after @ ..]) = (first, others)
            && let (Some(high), Some(low)) = (hex(*high), hex(*low))
        {
            out.push((high * 16 + low) as u8);
            rest = after;
            continue;
        }
        out.push(*first);
    }
    String::from_utf8_lossy(&out).into_owned()
}
