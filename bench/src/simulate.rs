//! Actors, links and learners on paper: how the protocol behaves at sizes that no machine here has.
//!
//! # Layout
//! - [`settings`] is what is simulated, and [`simulation`] the events. It follows the rules of the real parts:
//!   [`batcher`] those of `replay`, [`publisher`] those of the learner's publication, and `simulation` those of the actor's
//!   rounds, outbox and mailbox and of the learner's streams of unrolls.
//! - [`link`] is a link that transfers share, and [`agenda`] the queue of events. [`observed`] counts what happens, times in a
//!   [`distribution`], and [`report`] prints it.
//!
//! Not simulated: the processor time of the service, restarts and stalls of actors, lost packets and the latency of a network,
//! and the start of a process until it connects.

use std::io::Write as _;

use anyhow::{Context as _, Result};
use clap::Args;

use report::figures;
use settings::Settings;
use simulation::Simulation;

mod agenda;
mod batcher;
mod distribution;
mod link;
mod observed;
mod publisher;
mod report;
mod settings;
mod simulation;
#[cfg(test)]
mod tests;

/// Simulate actors and learners, to predict throughput, staleness, and the times of publication and start
///
/// A discrete-event simulation, decided by its seed. Defaults are the paper's sizes with times of docs/benchmarks.md; 100 ms
/// for an update is an assumption. Options that take a list simulate every combination.
///
/// `simulate.steps`: environment steps trained on a second, and what actors, learners and links alone would allow;
/// `few_versions` where fewer than ten versions were measured, so that figures may be those of the start. `busy`:
/// the time of updates, exchanges included. `age`: versions by which unrolls are late when they are trained on. `dropped`: stale
/// unrolls, by where that was found. `waiting`: the time in which actors do not step, and how long they wait for
/// acknowledgements and versions. `publication`: from a version's publication until every actor has it or a newer one; how
/// late versions are when an actor has read them; readers that were cut off and began again. `start`: until every actor acts.
/// `bytes_in`, `bytes_out`: of all learners. `service_cores`: what these bytes cost by docs/benchmarks.md. `memory`: most
/// that the buffers and connections of a learner hold. A value is null where it did not happen, or --give-up-s ended the wait.
#[derive(Clone, Debug, Args)]
pub struct Simulate {
    /// Actor processes
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "4000", value_parser = count)]
    actors: Vec<usize>,
    /// Threads of an actor; they share its connection and its parameters
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1", value_parser = count)]
    threads: Vec<usize>,
    /// Environments of a thread
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1", value_parser = count)]
    environments: Vec<usize>,
    /// Data-parallel learners: each has its part of the actors and of the batch, and a link
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1", value_parser = count)]
    learners: Vec<usize>,
    /// Speed of a learner's link in each direction, Gbit/s
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "25", value_parser = positive)]
    link_gbps: Vec<f64>,
    /// Time of an update of the whole batch by one learner, ms
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "100", value_parser = positive)]
    update_ms: Vec<f64>,
    /// Updates between versions
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "100", value_parser = natural)]
    target_period: Vec<u64>,
    /// Unrolls of a batch
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "128", value_parser = count)]
    batch: Vec<usize>,
    /// Both directions share the link's speed, as on one machine
    #[arg(long)]
    shared_link: bool,
    /// Time of one step of one environment, acting included, µs
    #[arg(long, default_value_t = 662.0, value_parser = at_least_one)]
    step_us: f64,
    /// Steps of an unroll
    #[arg(long, default_value_t = 32, value_parser = count)]
    length: usize,
    /// Batches that are assembled while one is trained on, 0 or 1
    #[arg(long, default_value_t = 1, value_parser = ahead)]
    ahead: usize,
    /// Updates by which an unroll may be late
    #[arg(long, default_value_t = 400)]
    max_staleness: u64,
    /// Bytes of an unroll
    #[arg(long, value_name = "BYTES", default_value_t = 208_436.0, value_parser = positive)]
    unroll_bytes: f64,
    /// Bytes of a version of the policy's parameters
    #[arg(long, value_name = "BYTES", default_value_t = 16_600_000.0, value_parser = positive)]
    parameter_bytes: f64,
    /// Bytes of the gradients that learners add in each update, on a network that nothing else uses
    #[arg(long, value_name = "BYTES", default_value_t = 30_500_000.0, value_parser = positive)]
    gradient_bytes: f64,
    /// Speed at which learners add gradients, Gbit/s, if --link-gbps is not lower. The default is gloo's between two learners
    /// of one machine, 0.8 GB/s (docs/data-parallel.md)
    #[arg(long, value_name = "GBPS", default_value_t = 6.4, value_parser = positive)]
    all_reduce_gbps: f64,
    /// Time of all else that learners exchange in an update, ms: an assumption. On two cores the exchanges of the quickstart's
    /// step took 7 to 10 ms, and 4.4 to 4.9 of these were for 3.5 MB of gradients
    #[arg(long, value_name = "MS", default_value_t = 3.0, value_parser = zero_or_more)]
    exchange_ms: f64,
    /// Bytes of the assets that an actor fetches at its start; 0 where it has them
    #[arg(long, value_name = "BYTES", default_value_t = 15_000_000.0, value_parser = zero_or_more)]
    asset_bytes: f64,
    /// Actors connect within this time, s
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, value_parser = time_or_none)]
    start_s: f64,
    /// Greatest relative difference of a round's time, of an update's, and of a connection's share of its link
    #[arg(long, default_value_t = 0.1, value_parser = spread)]
    spread: f64,
    /// Actors do not wait for the version that an acknowledgement names, as those of `swarm`
    #[arg(long)]
    any_version: bool,
    /// Seconds that are measured at least, after every actor acts and a quarter of this time
    #[arg(long, default_value_t = 300.0, value_parser = time)]
    seconds: f64,
    /// Versions that are measured at least, after a quarter as many, however long they take
    #[arg(long, value_name = "NUMBER", default_value_t = 20, value_parser = clap::value_parser!(u64).range(0..=100))]
    versions: u64,
    /// Simulated seconds after which the last actor is not waited for any more, at the start and for a version, nor the
    /// publication of a version
    #[arg(long, value_name = "SECONDS", default_value_t = 3600.0, value_parser = time)]
    give_up_s: f64,
    /// Decides every random number
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

impl Simulate {
    /// Simulates every combination and prints its figures.
    ///
    /// # Errors
    /// A combination that cannot be simulated; standard output that fails.
    pub fn run(&self) -> Result<()> {
        let points = self.points();
        points.iter().try_for_each(Settings::check)?;
        for settings in points {
            let observed = Simulation::new(settings).run();
            for line in figures(&settings, &observed) {
                writeln!(std::io::stdout(), "{line}").context("cannot write to standard output")?;
            }
        }
        Ok(())
    }

    /// Every combination of the lists.
    fn points(&self) -> Vec<Settings> {
        let points = vec![Settings {
            actors: 1,
            threads: 1,
            environments: 1,
            learners: 1,
            link_gbps: 1.0,
            update_ms: 1.0,
            target_period: 1,
            batch: 1,
            shared_link: self.shared_link,
            step_us: self.step_us,
            length: self.length,
            ahead: self.ahead,
            max_staleness: self.max_staleness,
            unroll_bytes: self.unroll_bytes,
            parameter_bytes: self.parameter_bytes,
            gradient_bytes: self.gradient_bytes,
            all_reduce_gbps: self.all_reduce_gbps,
            exchange_ms: self.exchange_ms,
            asset_bytes: self.asset_bytes,
            start_s: self.start_s,
            spread: self.spread,
            any_version: self.any_version,
            seconds: self.seconds,
            versions: self.versions,
            give_up_s: self.give_up_s,
            seed: self.seed,
        }];
        let points = swept(points, &self.actors, |point, actors| Settings { actors, ..point });
        let points = swept(points, &self.threads, |point, threads| Settings { threads, ..point });
        let points = swept(points, &self.environments, |point, environments| Settings { environments, ..point });
        let points = swept(points, &self.learners, |point, learners| Settings { learners, ..point });
        let points = swept(points, &self.link_gbps, |point, link_gbps| Settings { link_gbps, ..point });
        let points = swept(points, &self.update_ms, |point, update_ms| Settings { update_ms, ..point });
        let points = swept(points, &self.target_period, |point, target_period| Settings { target_period, ..point });
        swept(points, &self.batch, |point, batch| Settings { batch, ..point })
    }
}

/// Each of the points with each of the values.
fn swept<T: Copy>(points: Vec<Settings>, values: &[T], with: fn(Settings, T) -> Settings) -> Vec<Settings> {
    points.into_iter().flat_map(|point| values.iter().map(move |value| with(point, *value))).collect()
}

fn count(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(number @ 1..=1_000_000) => Ok(number),
        _ => Err("must be a whole number from 1 to 1000000".into()),
    }
}

fn natural(text: &str) -> Result<u64, String> {
    count(text).map(|number| number as u64)
}

fn ahead(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(number @ 0..=1) => Ok(number),
        _ => Err("must be 0 or 1".into()),
    }
}

fn number(text: &str, least: f64, most: f64) -> Result<f64, String> {
    match text.parse() {
        Ok(number) if (least..=most).contains(&number) => Ok(number),
        _ => Err(format!("must be a number from {least} to {most}")),
    }
}

fn positive(text: &str) -> Result<f64, String> {
    number(text, 1e-3, 1e12)
}

fn zero_or_more(text: &str) -> Result<f64, String> {
    number(text, 0.0, 1e12)
}

/// The clock of a longer simulation would not move by a short round.
const LONGEST_S: f64 = 1e6;

fn time(text: &str) -> Result<f64, String> {
    number(text, 1e-3, LONGEST_S)
}

fn time_or_none(text: &str) -> Result<f64, String> {
    number(text, 0.0, LONGEST_S)
}

/// A shorter step would not move the clock of a long simulation.
fn at_least_one(text: &str) -> Result<f64, String> {
    number(text, 1.0, 1e9)
}

fn spread(text: &str) -> Result<f64, String> {
    number(text, 0.0, 0.9)
}
