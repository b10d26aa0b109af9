//! A table as bytes.
//!
//! | bytes | content |
//! |-------|---------|
//! | 8 | the magic |
//! | 4 | the version of this format |
//! | 32 | the hash of the layout |
//! | 8 | items inserted |
//! | 8 | items sampled |
//! | 8 | n, the items that are there |
//! | n · (4 + unroll) | the items, the oldest first: task and fields in the order of the layout |
//! | 4 | CRC-32C of all bytes before |
//!
//! Numbers are little-endian. Nothing follows.

use std::io::{self, BufReader, BufWriter, Read, Write};
use std::sync::Arc;

use comic_proto::{Field, UnrollLayout};
use thiserror::Error;

use super::{Counts, Table, TableConfig, TableError};

const MAGIC: [u8; 8] = *b"CoMicTbl";
const VERSION: u32 = 1;
/// Bytes before the items.
const HEADER: u64 = 8 + 4 + 32 + 3 * 8;
const CHECKSUM: u64 = 4;
/// Greatest number of items inserted or sampled that is believed. No run reaches it, and none overflows after it.
const MAX_COUNT: u64 = 1 << 62;

/// The reason why a table cannot be read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReadTableError {
    /// The table that should hold the items cannot be made.
    #[error(transparent)]
    Table(#[from] TableError),
    /// The bytes cannot be read.
    #[error("cannot read the saved table: {0}")]
    Io(#[source] io::Error),
    /// The bytes end too early.
    #[error("the saved table is cut off")]
    CutOff,
    /// The bytes begin in another way.
    #[error("this is no saved table")]
    Magic,
    /// Another version of the format.
    #[error("the saved table has format {found}, and this program reads {VERSION}")]
    Version {
        /// The version of the saved table.
        found: u32,
    },
    /// Its unrolls have another layout.
    #[error("the unrolls of the saved table have another layout than those of this experiment")]
    Layout,
    /// The counts contradict each other.
    #[error(
        "the saved table has {len} items, of {} inserted and {} sampled ones, which cannot be",
        counts.inserted,
        counts.sampled
    )]
    Counts {
        /// The stored counts.
        counts: Counts,
        /// The stored number of items.
        len: u64,
    },
    /// The checksum is another one.
    #[error("the saved table is damaged: its checksum is {computed:08x} instead of {stored:08x}")]
    Checksum {
        /// The stored checksum.
        stored: u32,
        /// The checksum of the bytes.
        computed: u32,
    },
    /// More bytes follow.
    #[error("bytes follow after the saved table")]
    Trailing,
}

impl From<io::Error> for ReadTableError {
    fn from(error: io::Error) -> Self {
        if error.kind() == io::ErrorKind::UnexpectedEof { Self::CutOff } else { Self::Io(error) }
    }
}

impl Table {
    /// Bytes that [`write_to`](Self::write_to) writes now.
    pub fn saved_bytes(&self) -> u64 {
        Self::memory(self.unrolls.layout(), self.len).saturating_add(HEADER + CHECKSUM)
    }

    /// Writes the items that are there, the oldest first, and the counts. Needs little memory of its own.
    ///
    /// # Errors
    /// What the writer reports.
    pub fn write_to(&self, writer: impl Write) -> io::Result<()> {
        let mut out = Summed { stream: BufWriter::new(writer), sum: 0 };
        let layout = self.unrolls.layout();
        out.put(&MAGIC)?;
        out.put(&VERSION.to_le_bytes())?;
        out.put(&layout.hash())?;
        for number in [self.counts.inserted, self.counts.sampled, self.len as u64] {
            out.put(&number.to_le_bytes())?;
        }
        for number in self.evicted()..self.counts.inserted {
            let slot = self.slot(number);
            out.put(&self.tasks[slot].to_le_bytes())?;
            for field in Field::ALL {
                out.put(self.unrolls.bytes(field, slot))?;
            }
        }
        let sum = out.sum;
        out.put(&sum.to_le_bytes())?;
        out.stream.flush()
    }

    /// Reads a table that [`write_to`](Self::write_to) has written. The reader must end with it. Later samples are
    /// those of the saved table. If the saved table has more than `config.max_size` items, the oldest ones are left
    /// out.
    ///
    /// The bytes may be anything: the memory is that of `config`, and it is allocated only if the header is right.
    ///
    /// # Errors
    /// [`ReadTableError`], if the bytes are no whole table of this layout, or memory cannot hold the table.
    pub fn read_from(
        layout: Arc<UnrollLayout>,
        config: TableConfig,
        reader: impl Read,
    ) -> Result<Self, ReadTableError> {
        let mut from = Summed { stream: BufReader::new(reader), sum: 0 };
        if from.array()? != MAGIC {
            return Err(ReadTableError::Magic);
        }
        let found = u32::from_le_bytes(from.array()?);
        if found != VERSION {
            return Err(ReadTableError::Version { found });
        }
        if from.array()? != layout.hash() {
            return Err(ReadTableError::Layout);
        }
        let [inserted, sampled, len] = [from.number()?, from.number()?, from.number()?];
        let counts = Counts { inserted, sampled };
        if len > inserted || inserted.max(sampled) > MAX_COUNT {
            return Err(ReadTableError::Counts { counts, len });
        }
        let mut table = Self::new(layout, config)?;
        table.counts = counts;
        // At most `max_size`, so it is a usize.
        table.len = table.max_size().min(usize::try_from(len).unwrap_or(usize::MAX));
        for number in inserted - len..inserted {
            let slot = table.slot(number);
            table.tasks[slot] = u32::from_le_bytes(from.array()?);
            for field in Field::ALL {
                from.fill(table.unrolls.bytes_mut(field, slot))?;
            }
        }
        let computed = from.sum;
        let stored = u32::from_le_bytes(from.array()?);
        if stored != computed {
            return Err(ReadTableError::Checksum { stored, computed });
        }
        match from.array::<1>() {
            Ok(_) => Err(ReadTableError::Trailing),
            Err(end) if end.kind() == io::ErrorKind::UnexpectedEof => Ok(table),
            Err(error) => Err(error.into()),
        }
    }
}

/// A stream with the CRC-32C of its bytes so far.
struct Summed<S> {
    stream: S,
    sum: u32,
}

impl<W: Write> Summed<W> {
    fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.sum = crc32c::crc32c_append(self.sum, bytes);
        self.stream.write_all(bytes)
    }
}

impl<R: Read> Summed<R> {
    fn fill(&mut self, bytes: &mut [u8]) -> io::Result<()> {
        self.stream.read_exact(bytes)?;
        self.sum = crc32c::crc32c_append(self.sum, bytes);
        Ok(())
    }

    fn array<const N: usize>(&mut self) -> io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.fill(&mut bytes)?;
        Ok(bytes)
    }

    fn number(&mut self) -> io::Result<u64> {
        self.array().map(u64::from_le_bytes)
    }
}
