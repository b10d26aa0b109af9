//! Reads `.npz` files that `numpy.savez_compressed` wrote.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

/// One array: its shape and its values as f64, or its text.
#[derive(Clone, Debug)]
pub(crate) struct Array {
    /// Shape, empty for a scalar.
    pub(crate) shape: Vec<usize>,
    /// Values in row-major order.
    pub(crate) values: Values,
}

/// The values of an array.
#[derive(Clone, Debug)]
pub(crate) enum Values {
    /// Numbers of any type.
    Numbers(Vec<f64>),
    /// Unicode strings.
    Text(Vec<String>),
}

/// All arrays of a file by name.
pub(crate) type Arrays = BTreeMap<String, Array>;

/// Reads every array of `path`.
pub(crate) fn read(path: &Path) -> Result<Arrays, String> {
    let fail = |reason: String| format!("{}: {reason}", path.display());
    let mut archive = npyz::npz::NpzArchive::open(path).map_err(|error| fail(error.to_string()))?;
    let names: Vec<String> = archive.array_names().map(str::to_string).collect();
    let mut arrays = Arrays::new();
    for name in names {
        let mut bytes = Vec::new();
        archive
            .zip_archive()
            .by_name(&format!("{name}.npy"))
            .map_err(|error| fail(error.to_string()))?
            .read_to_end(&mut bytes)
            .map_err(|error| fail(error.to_string()))?;
        let array =
            parse(&bytes).ok_or_else(|| fail(format!("{name}: this reader does not know the array's format")))?;
        arrays.insert(name, array);
    }
    Ok(arrays)
}

/// The npy format, version 1 to 3: magic, header length, a Python dictionary, data.
fn parse(bytes: &[u8]) -> Option<Array> {
    let (length, start) = match bytes.get(6)? {
        1 => (u16::from_le_bytes(bytes.get(8..10)?.try_into().ok()?) as usize, 10),
        _ => (u32::from_le_bytes(bytes.get(8..12)?.try_into().ok()?) as usize, 12),
    };
    let header = std::str::from_utf8(bytes.get(start..start + length)?).ok()?;
    let data = bytes.get(start + length..)?;
    if header.contains("'fortran_order': True") {
        return None;
    }
    let kind = between(header, "'descr': '", "'")?;
    let shape: Vec<usize> = between(header, "'shape': (", ")")?
        .split(',')
        .map(str::trim)
        .filter(|part| !part.is_empty())
        .map(|part| part.parse().ok())
        .collect::<Option<_>>()?;
    let count: usize = shape.iter().product();
    let values = if let Some(width) = kind.strip_prefix("<U") {
        let width: usize = width.parse().ok()?;
        let text = data.chunks_exact(4 * width.max(1)).take(count).map(|chunk| {
            chunk
                .chunks_exact(4)
                .filter_map(|point| char::from_u32(u32::from_le_bytes(point.try_into().ok()?)))
                .filter(|point| *point != '\0')
                .collect()
        });
        Values::Text(text.collect())
    } else {
        macro_rules! numbers {
            ($type:ty) => {
                data.chunks_exact(size_of::<$type>())
                    .map(|chunk| <$type>::from_le_bytes(chunk.try_into().unwrap_or_default()) as f64)
                    .collect()
            };
        }
        Values::Numbers(match kind {
            "<f8" => numbers!(f64),
            "<f4" => numbers!(f32),
            "<i8" => numbers!(i64),
            "<i4" => numbers!(i32),
            "|i1" => numbers!(i8),
            "|u1" | "|b1" => numbers!(u8),
            _ => return None,
        })
    };
    let found = match &values {
        Values::Numbers(numbers) => numbers.len(),
        Values::Text(text) => text.len(),
    };
    (found == count).then_some(Array { shape, values })
}

fn between<'a>(text: &'a str, start: &str, end: &str) -> Option<&'a str> {
    let rest = &text[text.find(start)? + start.len()..];
    Some(&rest[..rest.find(end)?])
}

impl Array {
    /// The numbers of a numeric array.
    pub(crate) fn numbers(&self) -> Result<&[f64], String> {
        match &self.values {
            Values::Numbers(numbers) => Ok(numbers),
            Values::Text(_) => Err("expected numbers, found text".into()),
        }
    }

    /// The strings of a text array.
    pub(crate) fn texts(&self) -> Result<&[String], String> {
        match &self.values {
            Values::Text(text) => Ok(text),
            Values::Numbers(_) => Err("expected text, found numbers".into()),
        }
    }

    /// The only string of a text scalar.
    pub(crate) fn text(&self) -> Result<&str, String> {
        self.texts()?.first().map(String::as_str).ok_or_else(|| "no text".into())
    }

    /// Keeps the first `rows` rows.
    pub(crate) fn truncate(&mut self, rows: usize) {
        let width: usize = self.shape.iter().skip(1).product();
        if let (Values::Numbers(numbers), Some(length)) = (&mut self.values, self.shape.first_mut()) {
            *length = rows.min(*length);
            numbers.truncate(*length * width);
        }
    }

    /// Row `index` of a matrix.
    pub(crate) fn row(&self, index: usize) -> Result<&[f64], String> {
        let width: usize = self.shape.iter().skip(1).product();
        self.numbers()?.get(index * width..(index + 1) * width).ok_or_else(|| format!("no row {index}"))
    }
}
