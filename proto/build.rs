//! Compiles `comic/v1/learner.proto` with protox, so that no protoc has to be installed.

use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    const PROTO: &str = "comic/v1/learner.proto";
    println!("cargo:rerun-if-changed={PROTO}");
    let descriptors = protox::compile([PROTO], ["."])?;
    tonic_prost_build::configure()
        // The bulky fields, and no others: a `bytes::Bytes` field keeps the whole message it was cut from alive.
        .bytes(".comic.v1.UnrollMessage.payload")
        .bytes(".comic.v1.ParametersChunk.data")
        .bytes(".comic.v1.AssetChunk.data")
        .compile_fds(descriptors)?;
    Ok(())
}
