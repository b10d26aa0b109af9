//! Reads arrays of numbers from NumPy's .npz files: zip archives of .npy files.
//!
//! Reads no Python objects. Memory does not depend on what a file says about itself: an array grows as its numbers are
//! read, and what the library for archives would trust is checked first.

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use zip::ZipArchive;
use zip::result::ZipError;

use crate::error::Error;

/// Greatest length of a file, bytes. The longest recording of SMPL-X that is read, 360,000 frames, has about 500 million.
const LONGEST_FILE: u64 = 1 << 30;
/// Greatest number of arrays. A recording of AMASS has about ten. The library makes a list of all before it reads them.
const MOST_ARRAYS: usize = 100;
/// Most arrays whose names are in a message.
const MOST_SHOWN: usize = 60;
/// Most characters of a name in a message.
const LONGEST_SHOWN: usize = 60;
/// Greatest length of an array's header, bytes. NumPy pads it to 128 in most files.
const LONGEST_HEADER: usize = 1 << 16;
/// Greatest number of columns of an array. SMPL-X has 165.
const MOST_COLUMNS: usize = 1000;
/// Greatest absolute value of a number: far more than any angle in rad or length in m.
const LARGEST: f64 = 1e6;

/// An opened archive.
pub(super) struct Npz {
    path: PathBuf,
    archive: ZipArchive<BufReader<File>>,
}

/// What the header of an array says.
#[derive(Debug, PartialEq)]
struct Header {
    kind: Kind,
    /// Whether the first index runs fastest.
    fortran: bool,
    shape: Vec<usize>,
}

/// The little-endian number types that can be read.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Float32,
    Float64,
    Int32,
    Int64,
}

impl Npz {
    pub(super) fn open(path: &Path) -> Result<Self, Error> {
        let file = File::open(path).map_err(|reason| Error::Unreadable { path: path.into(), reason })?;
        let mut file = BufReader::new(file);
        let refuse = |reason: String| Error::Recording { path: path.into(), reason };
        let other =
            |reason: String| refuse(format!("not an .npz file ({reason}); a recording of AMASS is an .npz file"));
        check_size(&mut file).map_err(|reason| other(reason.to_string()))?.map_err(refuse)?;
        let archive = ZipArchive::new(file).map_err(|reason| other(reason.to_string()))?;
        Ok(Self { path: path.into(), archive })
    }

    /// The names of the arrays for a message, in alphabetical order.
    pub(super) fn keys(&self) -> Vec<String> {
        let mut keys: Vec<&str> = self.archive.file_names().filter_map(|name| name.strip_suffix(".npy")).collect();
        keys.sort_unstable();
        let shown = |key: &str| key.chars().filter(|letter| !letter.is_control()).take(LONGEST_SHOWN).collect();
        keys.into_iter().take(MOST_SHOWN).map(shown).collect()
    }

    pub(super) fn has(&self, key: &str) -> bool {
        self.archive.file_names().any(|name| name.strip_suffix(".npy") == Some(key))
    }

    /// An error about an array.
    pub(super) fn error(&self, key: &str, reason: impl std::fmt::Display) -> Error {
        Error::Recording { path: self.path.clone(), reason: format!("`{key}`: {reason}") }
    }

    /// The single number of an array of any shape; `None` if there is no such array.
    pub(super) fn scalar(&mut self, key: &str) -> Result<Option<f64>, Error> {
        if !self.has(key) {
            return Ok(None);
        }
        self.read(key, |header| match header.shape.iter().try_fold(1, |all: usize, n| all.checked_mul(*n)) {
            Some(1) => Ok([1, 1]),
            _ => Err(format!("has shape {:?}, expected one number", header.shape)),
        })
        .map(|rows: Vec<[f64; 1]>| rows.first().map(|[number]| *number))
    }

    /// The first `N` columns of an array of shape `[T, columns]`, row by row; `None` if there is no such array.
    ///
    /// # Errors
    /// [`Error::Recording`] if the array has no or more than `most` rows, fewer than `N` columns, numbers that are not
    /// finite or too large, or a type other than float32, float64, int32 and int64.
    pub(super) fn rows<const N: usize>(&mut self, key: &str, most: usize) -> Result<Option<Vec<[f64; N]>>, Error> {
        if !self.has(key) {
            return Ok(None);
        }
        let rows = self.read(key, |header| match *header.shape.as_slice() {
            [0, _] => Err("has no frames".into()),
            [rows, _] if rows > most => Err(format!("has {rows} frames, expected at most {most}; cut the recording")),
            [rows, columns] if (N..=MOST_COLUMNS).contains(&columns) => Ok([rows, columns]),
            _ => Err(format!("has shape {:?}, expected (frames, {N} or more)", header.shape)),
        })?;
        Ok(Some(rows))
    }

    /// Reads the first `N` columns of an array. `shape` checks the header, and gives rows and columns.
    fn read<const N: usize>(
        &mut self,
        key: &str,
        shape: impl Fn(&Header) -> Result<[usize; 2], String>,
    ) -> Result<Vec<[f64; N]>, Error> {
        let read = match self.archive.by_name(&format!("{key}.npy")) {
            Ok(file) => read_array(&mut BufReader::new(file), shape),
            Err(ZipError::Io(reason)) => Err(reason.to_string()),
            Err(reason) => Err(format!("cannot be read: {reason}")),
        };
        read.map_err(|reason| self.error(key, reason))
    }
}

/// Checks the length of a file, and the number of entries that the end of an archive says (APPNOTE.TXT of PKWARE, 4.3.16).
fn check_size(file: &mut (impl Read + Seek)) -> io::Result<Result<(), String>> {
    /// Length of the record at the end, without its comment of up to 65,535 bytes.
    const RECORD: usize = 22;
    /// Length of the record that an archive in the format ZIP64 has before it.
    const LOCATOR: usize = 20;
    let length = file.seek(SeekFrom::End(0))?;
    if length > LONGEST_FILE {
        return Ok(Err(format!("{length} bytes, expected at most {LONGEST_FILE}: cut the recording")));
    }
    let tail = length.min((LOCATOR + RECORD + usize::from(u16::MAX)) as u64);
    file.seek(SeekFrom::Start(length - tail))?;
    let mut end = Vec::new();
    file.take(tail).read_to_end(&mut end)?;
    file.seek(SeekFrom::Start(0))?;
    // Like the library: the last place that can be the record.
    let Some(at) = end.windows(RECORD).rposition(|record| record.starts_with(b"PK\x05\x06")) else {
        return Ok(Ok(()));
    };
    let large = at.checked_sub(LOCATOR).is_some_and(|locator| end[locator..].starts_with(b"PK\x06\x07"));
    let count = usize::from(u16::from_le_bytes([end[at + 8], end[at + 9]]));
    Ok(match large || count > MOST_ARRAYS {
        true => Err(format!("more than {MOST_ARRAYS} arrays: is this a recording of AMASS?")),
        false => Ok(()),
    })
}

fn read_array<const N: usize>(
    file: &mut impl Read,
    shape: impl Fn(&Header) -> Result<[usize; 2], String>,
) -> Result<Vec<[f64; N]>, String> {
    let header = Header::read(file)?;
    let [rows, columns] = shape(&header)?;
    let mut table: Vec<[f64; N]> = Vec::new();
    let place = |index: usize| match header.fortran {
        true => (index % rows, index / rows),
        false => (index / columns, index % columns),
    };
    // In Fortran order the columns that are not needed are at the end.
    let needed = if header.fortran { rows * N } else { rows * columns };
    let early = |reason: io::Error| format!("ends too early ({reason}): is the file complete?");
    for index in 0..needed {
        let number = header.kind.read(file).map_err(early)?;
        let (row, column) = place(index);
        if column >= N {
            continue;
        }
        if number.is_nan() || number.abs() > LARGEST {
            return Err(format!("is {number} in frame {row}, column {column}; expected finite numbers, rad and m"));
        }
        if row == table.len() {
            table.push([0.0; N]);
        }
        if let Some(entry) = table.get_mut(row).and_then(|row| row.get_mut(column)) {
            *entry = number;
        }
    }
    for _ in needed..rows * columns {
        header.kind.read(file).map_err(early)?;
    }
    // The library compares the checksum when it finds the end.
    match file.read(&mut [0]) {
        Ok(0) => Ok(table),
        Ok(_) => Err("is followed by other data: is the file damaged?".into()),
        Err(reason) => Err(format!("is damaged ({reason})")),
    }
}

impl Header {
    /// Reads the header of an .npy file: magic, version, length, and a Python dictionary as text
    /// (numpy.org/doc/stable/reference/generated/numpy.lib.format.html).
    fn read(file: &mut impl Read) -> Result<Self, String> {
        let broken = |reason: io::Error| format!("has a header that cannot be read ({reason})");
        let mut start = [0; 8];
        file.read_exact(&mut start).map_err(broken)?;
        let length = match start {
            [0x93, b'N', b'U', b'M', b'P', b'Y', 1, _] => {
                let mut length = [0; 2];
                file.read_exact(&mut length).map_err(broken)?;
                usize::from(u16::from_le_bytes(length))
            }
            [0x93, b'N', b'U', b'M', b'P', b'Y', 2 | 3, _] => {
                let mut length = [0; 4];
                file.read_exact(&mut length).map_err(broken)?;
                usize::try_from(u32::from_le_bytes(length)).unwrap_or(usize::MAX)
            }
            _ => return Err("is not an array of NumPy".into()),
        };
        if length > LONGEST_HEADER {
            return Err(format!("has a header of {length} bytes, expected at most {LONGEST_HEADER}"));
        }
        let mut text = vec![0; length];
        file.read_exact(&mut text).map_err(broken)?;
        Self::parse(&String::from_utf8_lossy(&text))
    }

    /// Parses `{'descr': '<f8', 'fortran_order': False, 'shape': (100, 156), }`.
    fn parse(text: &str) -> Result<Self, String> {
        let field = |key: &str| {
            let value = text.split_once(&format!("'{key}':")).map(|(_, value)| value.trim_start());
            value.ok_or_else(|| format!("has a header without {key}"))
        };
        let descr = field("descr")?;
        let name = descr.strip_prefix('\'').and_then(|rest| rest.split_once('\'')).map(|(name, _)| name);
        let kind = match name {
            Some("<f4") => Kind::Float32,
            Some("<f8") => Kind::Float64,
            Some("<i4") => Kind::Int32,
            Some("<i8") => Kind::Int64,
            other => {
                let found = other.unwrap_or("a structure");
                return Err(format!("has type {found}, expected <f4 or <f8: convert it with astype(\"<f8\")"));
            }
        };
        let fortran = field("fortran_order")?.starts_with("True");
        let numbers =
            field("shape")?.strip_prefix('(').and_then(|rest| rest.split_once(')')).map(|(numbers, _)| numbers);
        let shape = numbers.and_then(|numbers| {
            let numbers = numbers.split(',').map(str::trim).filter(|number| !number.is_empty());
            numbers.map(|number| number.parse().ok()).collect::<Option<Vec<usize>>>()
        });
        Ok(Self { kind, fortran, shape: shape.ok_or("has a header with an invalid shape")? })
    }
}

impl Kind {
    fn read(self, file: &mut impl Read) -> io::Result<f64> {
        let (mut four, mut eight) = ([0; 4], [0; 8]);
        Ok(match self {
            Self::Float32 => {
                file.read_exact(&mut four)?;
                f64::from(f32::from_le_bytes(four))
            }
            Self::Float64 => {
                file.read_exact(&mut eight)?;
                f64::from_le_bytes(eight)
            }
            Self::Int32 => {
                file.read_exact(&mut four)?;
                f64::from(i32::from_le_bytes(four))
            }
            Self::Int64 => {
                file.read_exact(&mut eight)?;
                i64::from_le_bytes(eight) as f64
            }
        })
    }
}
