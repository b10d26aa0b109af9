//! The program `comic-bench-learner`.

use clap::{Parser, Subcommand};
use comic_bench::replay::Replay;
use comic_bench::service::{Crowd, Host, Ingest, Publish, Stalled, Swarm};
use comic_bench::simulate::Simulate;
use comic_bench::update::{Ranks, Update};

/// The allocator of `comic-learner`.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Measures the learner's update, its replay and its service; one JSON line for each figure.
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    measurement: Measurement,
}

#[derive(Debug, Subcommand)]
enum Measurement {
    Update(Update),
    Ranks(Ranks),
    Replay(Replay),
    Ingest(Ingest),
    Publish(Publish),
    Stalled(Stalled),
    Swarm(Swarm),
    Simulate(Box<Simulate>),
    #[command(hide = true)]
    Host(Host),
    #[command(hide = true)]
    Crowd(Crowd),
}

fn main() -> anyhow::Result<()> {
    let Arguments { measurement } = Arguments::parse();
    comic_bench::start_logging();
    // As `comic-learner` does.
    comic_learner::threads::prepare_libraries();
    match measurement {
        // As in `comic-learner`, the update runs on a thread of its own: without MALLOC_ARENA_MAX its memory would be another arena.
        Measurement::Update(update) => {
            std::thread::spawn(move || update.run()).join().map_err(|_| anyhow::anyhow!("the measurement panicked"))?
        }
        Measurement::Ranks(ranks) => {
            std::thread::spawn(move || ranks.run()).join().map_err(|_| anyhow::anyhow!("the measurement panicked"))?
        }
        Measurement::Replay(replay) => replay.run(),
        Measurement::Ingest(ingest) => ingest.run(),
        Measurement::Publish(publish) => publish.run(),
        Measurement::Stalled(stalled) => stalled.run(),
        Measurement::Swarm(swarm) => swarm.run(),
        Measurement::Simulate(simulate) => simulate.run(),
        Measurement::Host(host) => host.run(),
        Measurement::Crowd(crowd) => crowd.run(),
    }
}
