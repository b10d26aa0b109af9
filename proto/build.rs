//! Compiles `comic/v1/learner.proto` with protox, so protoc need not be installed.

use std::error::Error;
use std::path::PathBuf;

use prost::Message as _;

fn main() -> Result<(), Box<dyn Error>> {
    const PROTO: &str = "comic/v1/learner.proto";
    println!("cargo:rerun-if-changed={PROTO}");
    let descriptors = protox::compile([PROTO], ["."])?;
    // The descriptors for gRPC reflection.
    let out = PathBuf::from(std::env::var_os("OUT_DIR").ok_or("cargo sets OUT_DIR")?);
    std::fs::write(out.join("descriptors.bin"), descriptors.encode_to_vec())?;
    tonic_prost_build::configure()
        // Only the large fields are `bytes::Bytes`: such a field keeps its whole message in memory.
        .bytes(".comic.v1.UnrollMessage.payload")
        .bytes(".comic.v1.ParametersChunk.data")
        .bytes(".comic.v1.AssetChunk.data")
        .bytes(".comic.v1.EvaluationReport.film")
        .compile_fds(descriptors)?;
    Ok(())
}
