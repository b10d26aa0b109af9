//! A reader of parameters that drops every byte: HTTP/2 by hand, with the largest windows.
//!
//! A client that decodes costs more than the server. On one machine a measurement would show the client alone.

use anyhow::Result;
use comic_proto::frame;
use comic_proto::v1::WatchRequest;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

const BUFFER: usize = 64 * 1024;
/// RFC 9113, 4.1: length, type, flags, stream.
const HEADER: usize = 9;
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const WINDOW_UPDATE: u8 = 8;
const ACK: u8 = 1;
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;
const LARGEST_WINDOW: u32 = 0x7fff_ffff;
const FIRST_WINDOW: u32 = 65_535;

/// Reads the parameters of an actor that has joined until the connection ends, and calls `count` with their bytes.
pub(super) async fn read(mut socket: TcpStream, incarnation: u64, mut count: impl FnMut(u64)) -> Result<()> {
    socket.set_nodelay(true)?;
    socket.write_all(&opening(incarnation)).await?;
    let (mut buffer, mut filled) = (vec![0; BUFFER], 0);
    // Bytes of the present frame that are still to be skipped.
    let mut left = 0;
    loop {
        let read = socket.read(&mut buffer[filled..]).await?;
        anyhow::ensure!(read > 0, "the learner closed the connection");
        filled += read;
        let mut place = 0;
        loop {
            let skipped = left.min(filled - place);
            place += skipped;
            left -= skipped;
            let Some(header) = buffer[place..filled].first_chunk::<HEADER>() else { break };
            let length = u32::from_be_bytes([0, header[0], header[1], header[2]]) as usize;
            let (kind, flags) = (header[3], header[4]);
            if kind == PING && flags & ACK == 0 {
                let Some(opaque) = buffer[place + HEADER..filled].first_chunk::<8>() else { break };
                socket.write_all(&encoded(PING, ACK, 0, opaque)).await?;
            } else if kind == SETTINGS && flags & ACK == 0 {
                socket.write_all(&encoded(SETTINGS, ACK, 0, &[])).await?;
            } else if kind == DATA {
                count(length as u64);
            }
            (place, left) = (place + HEADER, length);
        }
        // The beginning of a header, or of a ping, stays until the rest arrives.
        buffer.copy_within(place..filled, 0);
        filled -= place;
    }
}

/// The preface, the settings with the largest windows, and the call.
fn opening(incarnation: u64) -> Vec<u8> {
    let mut opening = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n".to_vec();
    let setting = |name: u16, value: u32| [&name.to_be_bytes()[..], &value.to_be_bytes()].concat();
    // RFC 9113, 6.5.2: initial window size and largest frame.
    opening.extend(encoded(SETTINGS, 0, 0, &[setting(4, LARGEST_WINDOW), setting(5, BUFFER as u32)].concat()));
    opening.extend(encoded(WINDOW_UPDATE, 0, 0, &(LARGEST_WINDOW - FIRST_WINDOW).to_be_bytes()));
    opening.extend(encoded(HEADERS, END_HEADERS, 1, &headers()));
    opening.extend(encoded(DATA, END_STREAM, 1, &frame(&WatchRequest { incarnation, ..WatchRequest::default() })));
    opening
}

/// RFC 7541: the names come from the static table; the values are literals.
fn headers() -> Vec<u8> {
    let text = |text: &str| [&[text.len() as u8], text.as_bytes()].concat();
    let (method_post, scheme_http) = ([0x83], [0x86]);
    let (path, authority, content_type, new_name) = ([0x04], [0x01], [0x0f, 0x10], [0x00]);
    [
        &method_post[..],
        &scheme_http,
        &path,
        &text("/comic.v1.Learner/WatchParameters"),
        &authority,
        &text("localhost"),
        &content_type,
        &text("application/grpc"),
        &new_name,
        &text("te"),
        &text("trailers"),
    ]
    .concat()
}

fn encoded(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = (payload.len() as u32).to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}
