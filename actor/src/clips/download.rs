//! Downloads a file of known size and SHA-256, with as many connections as it takes.

use std::fs::{File, OpenOptions};
use std::io::{Read, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use sha2::{Digest as _, Sha256};
use tempfile::TempPath;
use ureq::Agent;
use ureq::http::header::{CONTENT_RANGE, RANGE};
use ureq::http::{Response, StatusCode};

use crate::Error;

/// Size and hash of the complete file.
#[derive(Clone, Copy, Debug)]
pub struct Expected {
    /// Bytes.
    pub size: u64,
    /// Lower-case hexadecimal.
    pub sha256: &'static str,
}

/// A connection without a byte for this time is lost.
const SILENCE: Duration = Duration::from_secs(60);
/// Most attempts in a row without a new byte.
const FRUITLESS: usize = 3;
const PAUSE: Duration = Duration::from_millis(500);
const BUFFER: usize = 1 << 18;

/// Downloads `url` to `out`. The bytes go to `out.part` first, and a later call continues there. A lost connection is made
/// again while there is progress. `out` appears complete and verified, or not at all; a complete download that is not the
/// expected file is removed. Returns false when the file was there already. `progress` receives the number of bytes so far.
///
/// # Errors
/// [`Error::Download`] with the remedy; [`Error::Usage`] when `out` is another file and `overwrite` is not given;
/// [`Error::File`].
pub fn download(
    url: &str,
    out: &Path,
    expected: &Expected,
    overwrite: bool,
    progress: &mut dyn FnMut(u64),
) -> Result<bool, Error> {
    if out.exists() {
        if is_expected(out, expected)? {
            return Ok(false);
        }
        if !overwrite {
            let reason = "exists and is another file; add --force to replace it, or name another with --out";
            return Err(Error::Usage(format!("{} {reason}", out.display())));
        }
    }
    let download = Download { url, expected, part: part_of(out) };
    let mut file = download.open()?;
    download.complete(&mut file, progress)?;
    file.sync_all().map_err(Error::file(&download.part))?;
    if !is_expected(&download.part, expected)? {
        std::fs::remove_file(&download.part).map_err(Error::file(&download.part))?;
        return Err(download.failed("what came has another SHA-256, and was removed; try again, or another --url"));
    }
    place(&download.part, out)?;
    Ok(true)
}

fn part_of(out: &Path) -> PathBuf {
    let mut name = out.as_os_str().to_owned();
    name.push(".part");
    name.into()
}

fn place(part: &Path, out: &Path) -> Result<(), Error> {
    let mut temporary = TempPath::try_from_path(part).map_err(Error::file(part))?;
    // If the rename fails, the verified bytes stay.
    temporary.disable_cleanup(true);
    temporary.persist(out).map_err(|failed| Error::file(out)(failed.error))?;
    let directory = out.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(directory).and_then(|directory| directory.sync_all()).map_err(Error::file(directory))
}

fn is_expected(path: &Path, expected: &Expected) -> Result<bool, Error> {
    let mut file = File::open(path).map_err(Error::file(path))?;
    if file.metadata().map_err(Error::file(path))?.len() != expected.size {
        return Ok(false);
    }
    let mut hash = Sha256::new();
    std::io::copy(&mut file, &mut hash).map_err(Error::file(path))?;
    Ok(hex::encode(hash.finalize()) == expected.sha256)
}

struct Download<'a> {
    url: &'a str,
    expected: &'a Expected,
    part: PathBuf,
}

/// The end of an attempt that did not receive the last byte.
enum Ended {
    /// Another attempt may help.
    Lost(String),
    Fatal(Error),
}

impl Download<'_> {
    /// The partial file, locked: two downloads must not write the same file.
    fn open(&self) -> Result<File, Error> {
        let file = OpenOptions::new().create(true).append(true).open(&self.part).map_err(Error::file(&self.part))?;
        if file.try_lock().is_err() {
            return Err(self.failed("another process is fetching it; wait for that"));
        }
        if file.metadata().map_err(Error::file(&self.part))?.len() > self.expected.size {
            file.set_len(0).map_err(Error::file(&self.part))?;
        }
        Ok(file)
    }

    fn complete(&self, file: &mut File, progress: &mut dyn FnMut(u64)) -> Result<(), Error> {
        let agent = self.agent();
        let mut fruitless = 0;
        loop {
            let before = file.metadata().map_err(Error::file(&self.part))?.len();
            progress(before);
            if before == self.expected.size {
                return Ok(());
            }
            let reason = match self.attempt(&agent, file, before, progress) {
                Ok(()) => continue,
                Err(Ended::Fatal(error)) => return Err(error),
                Err(Ended::Lost(reason)) => reason,
            };
            let there = file.metadata().map_err(Error::file(&self.part))?.len();
            fruitless = if there > before { 0 } else { fruitless + 1 };
            if fruitless == FRUITLESS {
                return Err(self.failed(&format!(
                    "{reason}; check the network, or fetch it elsewhere and put it in place (--url names another \
                     address). {there} of {} bytes are kept, and the same command continues from there",
                    self.expected.size
                )));
            }
            tracing::warn!(reason, bytes = there, "the connection was lost: going on");
            std::thread::sleep(PAUSE);
        }
    }

    fn agent(&self) -> Agent {
        let config = Agent::config_builder()
            .http_status_as_error(false)
            .timeout_connect(Some(SILENCE / 2))
            .timeout_recv_response(Some(SILENCE))
            .timeout_per_read(Some(SILENCE));
        config.build().into()
    }

    /// One request for the missing bytes.
    fn attempt(&self, agent: &Agent, file: &mut File, there: u64, progress: &mut dyn FnMut(u64)) -> Result<(), Ended> {
        let mut request = agent.get(self.url);
        if there > 0 {
            request = request.header(RANGE, format!("bytes={there}-"));
        }
        let response = request.call().map_err(|error| match error {
            ureq::Error::BadUri(_) | ureq::Error::Http(_) => {
                Ended::Fatal(Error::Usage(format!("`{}` is no valid URL: {error}", self.url)))
            }
            error => Ended::Lost(error.to_string()),
        })?;
        let start = self.start(&response, file, there)?;
        let body = response.into_body().into_with_config().limit(u64::MAX).reader();
        self.take(body, file, start, progress)
    }

    /// The first byte of the response. The partial file is emptied when the response begins at byte 0.
    fn start(&self, response: &Response<ureq::Body>, file: &File, there: u64) -> Result<u64, Ended> {
        let wrong = |size: u64| {
            let reason = format!("the file there has {size} bytes, expected {}; try another --url", self.expected.size);
            Ended::Fatal(self.failed(&reason))
        };
        let again = || file.set_len(0).map_err(|error| Ended::Fatal(Error::file(&self.part)(error)));
        match response.status() {
            StatusCode::PARTIAL_CONTENT => {
                let range = response.headers().get(CONTENT_RANGE).and_then(|range| range.to_str().ok());
                let (start, size) = range.and_then(parse_range).ok_or_else(|| {
                    Ended::Fatal(self.failed("the server answers a request for a part without saying which part"))
                })?;
                match size {
                    Some(size) if size != self.expected.size => Err(wrong(size)),
                    _ if start == there => Ok(there),
                    _ => again().and(Err(Ended::Lost(format!("the server sent bytes from {start}, not {there}")))),
                }
            }
            StatusCode::OK => {
                if let Some(size) = response.body().content_length().filter(|size| *size != self.expected.size) {
                    return Err(wrong(size));
                }
                if there > 0 {
                    tracing::warn!("the server sends whole files only: beginning again");
                }
                again().map(|()| 0)
            }
            StatusCode::RANGE_NOT_SATISFIABLE => again().and(Err(Ended::Lost("the server's file is shorter".into()))),
            status if status.is_server_error() => Err(Ended::Lost(format!("the server answered {status}"))),
            status => Err(Ended::Fatal(self.failed(&format!("the server answered {status}; try another --url")))),
        }
    }

    fn take(
        &self,
        mut body: impl Read,
        file: &mut File,
        start: u64,
        progress: &mut dyn FnMut(u64),
    ) -> Result<(), Ended> {
        let mut buffer = vec![0; BUFFER];
        let mut there = start;
        loop {
            let read = body.read(&mut buffer).map_err(|error| Ended::Lost(error.to_string()))?;
            if read == 0 {
                break;
            }
            there += read as u64;
            if there > self.expected.size {
                let reason =
                    format!("the file there has over the expected {} bytes; try another --url", self.expected.size);
                file.set_len(0).map_err(|error| Ended::Fatal(Error::file(&self.part)(error)))?;
                return Err(Ended::Fatal(self.failed(&reason)));
            }
            file.write_all(&buffer[..read]).map_err(|error| Ended::Fatal(Error::file(&self.part)(error)))?;
            progress(there);
        }
        if there < self.expected.size { Err(Ended::Lost("the connection closed early".into())) } else { Ok(()) }
    }

    fn failed(&self, reason: &str) -> Error {
        Error::Download { url: self.url.into(), reason: reason.into() }
    }
}

/// First byte and size of `bytes 5-99/100`; the size may be `*`.
fn parse_range(range: &str) -> Option<(u64, Option<u64>)> {
    let (range, size) = range.strip_prefix("bytes ")?.split_once('/')?;
    let (first, _) = range.split_once('-')?;
    Some((first.parse().ok()?, if size == "*" { None } else { Some(size.parse().ok()?) }))
}
