//! How several learners meet: their part of the command line, and what they tell each other of their addresses.

use std::fmt;
use std::io::ErrorKind;
use std::net::{IpAddr, Ipv6Addr, SocketAddr, TcpListener, TcpStream, ToSocketAddrs as _};
use std::str::FromStr;
use std::time::{Duration, Instant};

use clap::Args;
use comic_experiment::{DeviceName, Experiment};

use crate::error::{Error, Result};
use crate::world::{self, MEETING, World};

/// How long rank 0's own name may have no address yet, or that of a former pod.
const NAMING: Duration = Duration::from_secs(120);
/// How long one attempt to reach rank 0 may take.
const ATTEMPT: Duration = Duration::from_secs(5);
const AGAIN: Duration = Duration::from_secs(1);

/// Several learners that train one run together.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Several learners")]
pub struct WorldArguments {
    /// Learners that train this run together. Each takes its share of every batch.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub world_size: usize,
    /// Which of them this is, from 0. Rank 0 has the run's directory, and actors and evaluators begin at its address.
    #[arg(long, value_name = "R", default_value_t = 0)]
    pub rank: usize,
    /// Where they meet: an address of rank 0's machine, on a private network. What they exchange is not encrypted.
    #[arg(long, value_name = "HOST:PORT")]
    pub rendezvous: Option<Rendezvous>,
    /// Where actors reach this rank [default: --address and --port, or the address towards the rendezvous if --address is 0.0.0.0].
    #[arg(long, value_name = "HOST:PORT")]
    pub advertise: Option<Rendezvous>,
}

/// Characters that no host has, but for an IPv6 address in brackets.
const FORBIDDEN: [char; 8] = ['/', '@', '?', ' ', '\t', ':', '[', ']'];
/// Most bytes of a host's name (RFC 1035, without the dots at its ends).
const HOST_LIMIT: usize = 253;

/// A host and a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rendezvous {
    host: String,
    port: u16,
}

impl FromStr for Rendezvous {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let parts = text.rsplit_once(':').map(|(host, port)| (host, port.parse()));
        let host_of = |text: &str| match text.strip_prefix('[').and_then(|text| text.strip_suffix(']')) {
            Some(host) => host.parse::<Ipv6Addr>().is_ok().then(|| host.to_owned()),
            None => ((1..=HOST_LIMIT).contains(&text.len()) && !text.contains(FORBIDDEN)).then(|| text.to_owned()),
        };
        match parts.map(|(host, port)| (host_of(host), port)) {
            Some((Some(host), Ok(port))) if port > 0 => Ok(Self { host, port }),
            _ => Err("this is not HOST:PORT, for instance learner-0:7071".into()),
        }
    }
}

impl fmt::Display for Rendezvous {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { host, port } = self;
        if host.contains(':') { write!(formatter, "[{host}]:{port}") } else { write!(formatter, "{host}:{port}") }
    }
}

impl WorldArguments {
    /// Checks that such learners can train this experiment together.
    ///
    /// # Errors
    /// [`Error::Configuration`] with the remedy.
    pub fn check(&self, experiment: &Experiment) -> Result<()> {
        let &Self { world_size: size, rank, ref rendezvous, ref advertise } = self;
        if size == 0 || rank >= size {
            return wrong(format!(
                "--rank {rank} of --world-size {size}: ranks count from 0 and are below the world size"
            ));
        }
        if size == 1 {
            let given = rendezvous.is_some() || advertise.is_some();
            let remedy = "--rendezvous and --advertise are for several learners: give --world-size, too";
            return if given { wrong(remedy.into()) } else { Ok(()) };
        }
        if rendezvous.is_none() {
            return wrong(format!("--world-size {size} needs --rendezvous HOST:PORT, an address of rank 0's machine"));
        }
        if let Some(advertised) = advertise.as_ref().filter(|advertised| advertised.is_unspecified()) {
            let remedy = format!("--advertise {advertised} is no address that actors can reach: name this machine");
            return wrong(remedy);
        }
        experiment.share(size)?;
        if let DeviceName::Xla(_) = experiment.learner.device {
            return wrong("several learners can compute on cpu and cuda: on xla they cannot yet".into());
        }
        Ok(())
    }
}

/// The ranks that have met.
#[derive(Debug)]
pub struct Meeting {
    /// The ranks.
    pub world: World,
    /// Where actors reach each of them: host and port.
    pub addresses: Vec<String>,
}

impl Meeting {
    /// Meets the other ranks, and blocks until all are there; a learner alone goes on at once. This rank serves at `serving`.
    ///
    /// # Errors
    /// When rank 0 cannot listen at the rendezvous, or when the others do not come.
    pub fn hold(arguments: &WorldArguments, serving: SocketAddr) -> Result<Self> {
        let &WorldArguments { world_size: size, rank, ref rendezvous, ref advertise } = arguments;
        let Some(rendezvous) = rendezvous.as_ref().filter(|_| size > 1) else {
            return Ok(Self { world: World::alone(), addresses: Vec::new() });
        };
        tracing::info!(rank, size, %rendezvous, "waiting for the other ranks");
        let begun = Instant::now();
        let (address, listener) = rendezvous.reach(rank)?;
        if listener.is_some() {
            // Some systems give a machine's own name a loopback address, which the other machines cannot reach.
            tracing::info!(%address, "the other ranks can meet this one here");
        }
        let own = match advertise {
            Some(advertised) => advertised.clone(),
            None => Rendezvous::of(advertised(serving, address)?),
        };
        let patience = MEETING.saturating_sub(begun.elapsed()).max(ATTEMPT);
        let world = World::meet(rank, size, address, listener, patience)?;
        let addresses = world.exchange(own.to_string())?;
        tracing::info!(rank, size, ?addresses, "all ranks are here");
        Ok(Self { world, addresses })
    }
}

impl Rendezvous {
    fn of(address: SocketAddr) -> Self {
        Self { host: address.ip().to_string(), port: address.port() }
    }

    fn is_unspecified(&self) -> bool {
        self.host.parse::<IpAddr>().is_ok_and(|address| address.is_unspecified())
    }

    /// The address, at which rank 0 then listens, and rank 0's socket. Others wait until it listens. A name may be that of a former pod
    /// for some time, so it is looked up again and again.
    fn reach(&self, rank: usize) -> Result<(SocketAddr, Option<TcpListener>)> {
        let begun = Instant::now();
        loop {
            let error = match self.attempt(rank) {
                Ok(reached) => return Ok(reached),
                Err(error) => error,
            };
            let patience = if rank == 0 { NAMING } else { MEETING };
            if begun.elapsed() >= patience || error.kind() == ErrorKind::AddrInUse {
                return Err(match rank {
                    0 => Error::system(format!(
                        "--rendezvous {self}: it must be an address of this machine, with a free port"
                    ))(error),
                    _ => world::Error::Unreachable { rank, rendezvous: self.to_string(), source: error }.into(),
                });
            }
            std::thread::sleep(AGAIN);
        }
    }

    fn attempt(&self, rank: usize) -> std::io::Result<(SocketAddr, Option<TcpListener>)> {
        let mut failed = std::io::Error::from(ErrorKind::NotFound);
        for address in (self.host.as_str(), self.port).to_socket_addrs()? {
            let reached = match rank {
                0 => TcpListener::bind(address).map(Some),
                _ => TcpStream::connect_timeout(&address, ATTEMPT).map(|_| None),
            };
            match reached {
                Ok(listener) => return Ok((address, listener)),
                Err(error) => failed = error,
            }
        }
        Err(failed)
    }
}

/// Where actors reach a learner that serves at `serving` and meets the others at `rendezvous`.
fn advertised(serving: SocketAddr, rendezvous: SocketAddr) -> Result<SocketAddr> {
    if serving.ip().is_loopback() && !rendezvous.ip().is_loopback() {
        let remedy = format!(
            "actors of other machines cannot reach --address {}: give 0.0.0.0, or say with --advertise where they can",
            serving.ip()
        );
        return Err(Error::Configuration(remedy));
    }
    if !serving.ip().is_unspecified() {
        return Ok(serving);
    }
    let reachable = World::reachable_address(rendezvous);
    Ok(SocketAddr::new(reachable.map_err(Error::system("this machine has no address"))?, serving.port()))
}

fn wrong(message: String) -> Result<()> {
    Err(Error::Configuration(message))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arguments(size: usize, rank: usize) -> WorldArguments {
        let rendezvous = Some("here:7071".parse().unwrap());
        WorldArguments { world_size: size, rank, rendezvous, advertise: None }
    }

    #[test]
    fn what_cannot_be_shared_is_refused_with_its_field() {
        let refused = |change: fn(&mut Experiment), arguments: WorldArguments| {
            let mut experiment = Experiment::default();
            change(&mut experiment);
            arguments.check(&experiment).unwrap_err().to_string()
        };
        let odd = refused(|experiment| experiment.unroll.batch = 127, arguments(2, 1));
        assert!(odd.contains("unroll.batch = 127") && odd.contains("multiple of 2"), "{odd}");
        assert!(refused(|experiment| experiment.learner.device = DeviceName::Xla(0), arguments(2, 1)).contains("xla"));
        assert!(refused(|_| {}, arguments(2, 2)).contains("--rank 2"));
        let nowhere = WorldArguments { rendezvous: None, ..arguments(2, 0) };
        assert!(refused(|_| {}, nowhere).contains("--rendezvous"));
        assert!(refused(|_| {}, arguments(1, 0)).contains("--world-size"));
        let advertising = |text: &str| WorldArguments { advertise: Some(text.parse().unwrap()), ..arguments(4, 3) };
        for unreachable in ["0.0.0.0:7070", "[::]:7070"] {
            let refused = advertising(unreachable).check(&Experiment::default()).unwrap_err().to_string();
            assert!(refused.contains(unreachable), "{refused}");
        }
        for reachable in ["192.0.2.7:7070", "learner-3:7070"] {
            advertising(reachable).check(&Experiment::default()).unwrap();
        }
        arguments(4, 3).check(&Experiment::default()).unwrap();
    }

    #[test]
    fn actors_are_told_an_address_that_they_can_reach() {
        let at = |text: &str| text.parse::<SocketAddr>().unwrap();
        let [here, everywhere, outside] = ["127.0.0.1:7070", "0.0.0.0:7070", "192.0.2.7:7070"].map(at);
        assert_eq!(advertised(here, at("127.0.0.1:7071")).unwrap(), here);
        assert_eq!(advertised(everywhere, at("127.0.0.1:7071")).unwrap(), here);
        assert_eq!(advertised(outside, at("192.0.2.8:7071")).unwrap(), outside);
        let refused = advertised(here, at("192.0.2.8:7071")).unwrap_err();
        assert!(refused.exit_code() == 2 && refused.to_string().contains("--advertise"), "{refused}");
    }

    #[test]
    fn a_rendezvous_has_a_host_and_a_port() {
        for text in ["learner-0:7071", "127.0.0.1:1", "[::1]:7071"] {
            assert_eq!(text.parse::<Rendezvous>().unwrap().to_string(), text);
        }
        for text in [
            "",
            "learner-0",
            ":7071",
            "learner-0:70710",
            "learner-0:",
            "learner-0:0",
            "http://a:1",
            "a@b:1",
            "a b:1",
            "a:b:1",
            "[a]:1",
        ] {
            assert!(text.parse::<Rendezvous>().is_err(), "{text}");
        }
        for (length, accepted) in [(253, true), (254, false)] {
            assert_eq!(format!("{}:1", "a".repeat(length)).parse::<Rendezvous>().is_ok(), accepted, "{length}");
        }
    }
}
