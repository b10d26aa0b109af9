//! Messages that are encoded in advance.

use bytes::{BufMut as _, Bytes, BytesMut};
use prost::Message;

/// A message as gRPC sends it: the byte 0 for "not compressed", the length in four bytes (big-endian), the message. The
/// message must be smaller than 4 GiB.
pub fn frame(message: &impl Message) -> Bytes {
    let length = message.encoded_len();
    let mut frame = BytesMut::with_capacity(5 + length);
    frame.put_u8(0);
    frame.put_u32(length as u32);
    message.encode_raw(&mut frame);
    frame.freeze()
}
