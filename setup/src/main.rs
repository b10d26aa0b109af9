//! Set-up alone, for the Docker image: `cargo run --package comic-setup` fills `.deps` as `cargo xtask setup` does.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;

/// Fetch libmujoco, libtorch and the humanoid
#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    options: comic_setup::Options,
    /// Directory for them
    #[arg(long, value_name = "DIR", default_value = ".deps")]
    into: PathBuf,
}

fn main() -> ExitCode {
    let Arguments { options, into } = Arguments::parse();
    match comic_setup::run(&options, &into) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
