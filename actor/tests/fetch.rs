//! `clips fetch` with servers on the loopback address, which behave as real servers do or fail.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot continue fails")]

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;

use comic_actor::Error;
use comic_actor::clips::{Expected, download};
use parking_lot::Mutex;

const FILE: &[u8] = b"the quick brown fox jumps over the lazy dog";
const EXPECTED: Expected =
    Expected { size: 43, sha256: "05c6e08f1d9fdafa03147fcb8f82f124c76d2f70e3d989dc8aadb5e7d7450bec" };

/// The first byte that a request asks for, if it asks for a range.
type Wanted = Option<usize>;

/// A server that answers each connection with `answer(number of the connection, requested range)`, then closes it.
struct Server {
    url: String,
    requests: Arc<Mutex<Vec<Wanted>>>,
}

impl Server {
    fn start(answer: impl Fn(usize, Wanted) -> Vec<u8> + Send + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}/clips.h5", listener.local_addr().unwrap());
        let requests: Arc<Mutex<Vec<Wanted>>> = Arc::default();
        let seen = requests.clone();
        std::thread::spawn(move || {
            for (turn, stream) in listener.incoming().enumerate() {
                let mut stream = stream.unwrap();
                let wanted = wanted(&stream);
                seen.lock().push(wanted);
                // A client may close the connection before the end.
                let _ = stream.write_all(&answer(turn, wanted));
            }
        });
        Self { url, requests }
    }

    fn requests(&self) -> Vec<Wanted> {
        self.requests.lock().clone()
    }
}

fn wanted(stream: &TcpStream) -> Wanted {
    let mut range = None;
    for line in BufReader::new(stream).lines() {
        let line = line.unwrap().to_lowercase();
        if let Some(first) = line.strip_prefix("range: bytes=") {
            range = Some(first.trim_end_matches('-').parse().unwrap());
        }
        if line.is_empty() {
            break;
        }
    }
    range
}

/// A response whose head announces all of `body`, with the first `sent` bytes of it.
fn whole(body: &[u8], sent: usize) -> Vec<u8> {
    let head = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len());
    [head.as_bytes(), &body[..sent]].concat()
}

fn part(body: &[u8], first: usize, sent: usize) -> Vec<u8> {
    let (last, size) = (body.len() - 1, body.len());
    let head = format!(
        "HTTP/1.1 206 Partial Content\r\nContent-Range: bytes {first}-{last}/{size}\r\nContent-Length: {}\r\n\
         Connection: close\r\n\r\n",
        size - first
    );
    [head.as_bytes(), &body[first..(first + sent).min(size)]].concat()
}

/// A correct server: it respects ranges.
fn honest(_: usize, wanted: Wanted) -> Vec<u8> {
    wanted.map_or_else(|| whole(FILE, FILE.len()), |first| part(FILE, first, FILE.len()))
}

fn fetch(server: &Server, directory: &Path) -> Result<bool, Error> {
    download(&server.url, &directory.join("clips.h5"), &EXPECTED, false, &mut |_| ())
}

fn files_in(directory: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        std::fs::read_dir(directory).unwrap().map(|file| file.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_file_arrives_whole_with_progress_and_is_not_fetched_again() {
    let (server, directory) = (Server::start(honest), tempfile::tempdir().unwrap());
    let (out, mut told) = (directory.path().join("clips.h5"), Vec::new());
    assert!(download(&server.url, &out, &EXPECTED, false, &mut |bytes| told.push(bytes)).unwrap());
    assert_eq!(std::fs::read(&out).unwrap(), FILE);
    assert_eq!((told.first(), told.last()), (Some(&0), Some(&43)));
    assert!(!fetch(&server, directory.path()).unwrap());
    assert_eq!((server.requests(), files_in(directory.path())), (vec![None], vec!["clips.h5".into()]));
}

#[test]
fn a_download_resumes_from_the_part_of_an_earlier_call() {
    let (server, directory) = (Server::start(honest), tempfile::tempdir().unwrap());
    std::fs::write(directory.path().join("clips.h5.part"), &FILE[..20]).unwrap();
    assert!(fetch(&server, directory.path()).unwrap());
    assert_eq!(std::fs::read(directory.path().join("clips.h5")).unwrap(), FILE);
    assert_eq!((server.requests(), files_in(directory.path())), (vec![Some(20)], vec!["clips.h5".into()]));
}

#[test]
fn a_download_resumes_where_the_connection_broke() {
    let server = Server::start(|_, wanted| wanted.map_or_else(|| whole(FILE, 10), |first| part(FILE, first, 12)));
    let directory = tempfile::tempdir().unwrap();
    assert!(fetch(&server, directory.path()).unwrap());
    assert_eq!(server.requests(), [None, Some(10), Some(22), Some(34)]);
}

#[test]
fn a_server_that_ignores_ranges_sends_the_whole_file_again() {
    let server = Server::start(|_, _| whole(FILE, FILE.len()));
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("clips.h5.part"), b"something else").unwrap();
    assert!(fetch(&server, directory.path()).unwrap());
    assert_eq!(std::fs::read(directory.path().join("clips.h5")).unwrap(), FILE);
}

#[test]
fn a_file_with_another_hash_is_removed_and_reported() {
    let server = Server::start(|_, _| whole(&[b'x'; 43], 43));
    let directory = tempfile::tempdir().unwrap();
    let message = fetch(&server, directory.path()).unwrap_err().to_string();
    assert!(
        message.ends_with("what came has another SHA-256, and was removed; try again, or another --url"),
        "{message}"
    );
    assert_eq!(files_in(directory.path()), [""; 0]);
}

#[test]
fn another_size_is_refused_before_a_byte_is_written() {
    let server =
        Server::start(|_, wanted| wanted.map_or_else(|| whole(&FILE[..9], 9), |first| part(&FILE[..40], first, 40)));
    let directory = tempfile::tempdir().unwrap();
    let message = fetch(&server, directory.path()).unwrap_err().to_string();
    assert!(message.ends_with("the file there has 9 bytes, expected 43; try another --url"), "{message}");
    std::fs::write(directory.path().join("clips.h5.part"), &FILE[..20]).unwrap();
    let message = fetch(&server, directory.path()).unwrap_err().to_string();
    assert!(message.contains("40 bytes, expected 43"), "{message}");
    assert_eq!(
        std::fs::read(directory.path().join("clips.h5.part")).unwrap(),
        &FILE[..20],
        "the part is kept for the right server"
    );
}

#[test]
fn a_response_without_end_is_cut_at_the_expected_size() {
    let server =
        Server::start(|_, _| [b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n".as_slice(), &[b'x'; 4096]].concat());
    let directory = tempfile::tempdir().unwrap();
    let message = fetch(&server, directory.path()).unwrap_err().to_string();
    assert!(message.contains("over the expected 43 bytes"), "{message}");
}

#[test]
fn without_a_network_the_error_names_the_remedy_and_the_part_is_kept() {
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("clips.h5.part"), &FILE[..20]).unwrap();
    let server = Server { url: format!("http://{address}/clips.h5"), requests: Arc::default() };
    let message = fetch(&server, directory.path()).unwrap_err().to_string();
    for said in ["cannot fetch http://127.0.0.1", "check the network", "--url", "20 of 43 bytes are kept"] {
        assert!(message.contains(said), "{message}");
    }
    assert_eq!(files_in(directory.path()), ["clips.h5.part"]);
}

#[test]
fn a_missing_page_and_a_bad_address_are_errors_at_once() {
    let server =
        Server::start(|_, _| b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".to_vec());
    let directory = tempfile::tempdir().unwrap();
    let message = fetch(&server, directory.path()).unwrap_err().to_string();
    assert!(message.ends_with("the server answered 404 Not Found; try another --url"), "{message}");
    assert_eq!(server.requests().len(), 1);
    let error = download("nowhere", &directory.path().join("b"), &EXPECTED, false, &mut |_| ()).unwrap_err();
    assert!(error.is_configuration(), "{error}");
}

#[test]
fn another_file_with_the_same_name_is_replaced_only_on_demand() {
    let (server, directory) = (Server::start(honest), tempfile::tempdir().unwrap());
    let out = directory.path().join("clips.h5");
    std::fs::write(&out, "mine").unwrap();
    let message = fetch(&server, directory.path()).unwrap_err().to_string();
    assert!(message.contains("exists and is another file; add --force"), "{message}");
    assert!(download(&server.url, &out, &EXPECTED, true, &mut |_| ()).unwrap());
    assert_eq!(std::fs::read(&out).unwrap(), FILE);
}
