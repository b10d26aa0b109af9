//! The program `comic-bench-actor`.

use clap::Parser;
use comic_bench::actor::Bench;

/// Measures how fast an actor is; one JSON line for each figure.
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    #[command(flatten)]
    bench: Bench,
}

fn main() -> anyhow::Result<()> {
    let Arguments { bench } = Arguments::parse();
    comic_bench::start_logging();
    comic_actor::policy::use_one_torch_thread();
    bench.run()
}
