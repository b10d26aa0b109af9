//! Compiles `comic/v1/learner.proto` with protox, so that no protoc has to be installed.

use std::error::Error;
use std::path::PathBuf;

use prost::Message as _;

fn main() -> Result<(), Box<dyn Error>> {
    const PROTO: &str = "comic/v1/learner.proto";
    println!("cargo:rerun-if-changed={PROTO}");
    let descriptors = protox::compile([PROTO], ["."])?;
    // What reflection answers with.
    let out = PathBuf::from(std::env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?);
    std::fs::write(out.join("descriptors.bin"), descriptors.encode_to_vec())?;
    tonic_prost_build::configure()
        // The bulky fields, and no others: a `bytes::Bytes` field keeps the whole message it was cut from alive.
        .bytes(".comic.v1.UnrollMessage.payload")
        .bytes(".comic.v1.ParametersChunk.data")
        .bytes(".comic.v1.AssetChunk.data")
        .compile_fds(descriptors)?;
    Ok(())
}
