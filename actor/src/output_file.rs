//! A file that gets its name when it is whole.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

/// A file that is being written under another name in the same directory. What had the name before stays until
/// [`finish`](Self::finish). A file that is dropped before is removed.
#[derive(Debug)]
pub(crate) struct OutputFile {
    out: PathBuf,
    file: NamedTempFile,
}

impl OutputFile {
    /// Begins the file that will be `out`.
    ///
    /// # Errors
    /// When the directory refuses.
    pub(crate) fn create(out: &Path) -> io::Result<Self> {
        let directory = out.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let mut builder = tempfile::Builder::new();
        builder.prefix(".comic-");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt as _;
            // The process's umask applies, as for other files.
            builder.permissions(std::fs::Permissions::from_mode(0o666));
        }
        Ok(Self { out: out.to_path_buf(), file: builder.tempfile_in(directory)? })
    }

    /// The open file.
    pub(crate) fn file(&self) -> &File {
        self.file.as_file()
    }

    /// Where it is until it is finished.
    pub(crate) fn path(&self) -> &Path {
        self.file.path()
    }

    /// Its name when it is finished.
    pub(crate) fn out(&self) -> &Path {
        &self.out
    }

    /// Gives the file its name, when all of it is on the disk.
    ///
    /// # Errors
    /// When the disk refuses.
    pub(crate) fn finish(self) -> io::Result<()> {
        self.file.as_file().sync_all()?;
        self.file.persist(&self.out).map_err(|error| error.error)?;
        Ok(())
    }
}
