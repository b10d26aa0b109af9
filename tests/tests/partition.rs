//! A learner and an actor on separate hosts. The network between them loses everything for a while.
//!
//! Hosts are network namespaces, which need root. Without it, `cargo xtask test` says that these tests are not run.

use std::net::Ipv4Addr;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use comic_tests::steps::{LIMIT, leaves, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System};

/// The documented time in which a silent peer is noticed.
const NOTICED: Duration = Duration::from_secs(30);

/// The actor's host, at the other end of a cable.
struct Host {
    name: String,
    /// The learner's end.
    cable: String,
    learner: String,
    actor: String,
}

impl Host {
    /// `number` is different in every test, so their hosts are different.
    fn new(number: u8) -> Result<Self> {
        let name = format!("comic-{}-{number}", std::process::id());
        let (cable, end) = (format!("cl{}{number}", std::process::id()), format!("ca{}{number}", std::process::id()));
        // Only this test uses these four addresses of 10.128.0.0/9. Hosts of an interrupted run have others.
        let block = (std::process::id().wrapping_mul(4) + u32::from(number)) % (1 << 21);
        let address = |end: u32| Ipv4Addr::from_bits(0x0a80_0000 + 4 * block + end).to_string();
        let host = Self { learner: address(1), actor: address(2), name, cable };
        let Self { name, cable, learner, actor } = &host;
        for command in [
            format!("netns add {name}"),
            format!("link add {cable} type veth peer name {end} netns {name}"),
            format!("address add {learner}/30 dev {cable}"),
            format!("link set {cable} up"),
            format!("-n {name} address add {actor}/30 dev {end}"),
            format!("-n {name} link set {end} name cable"),
            format!("-n {name} link set cable up"),
        ] {
            ip(&command)?;
        }
        Ok(host)
    }

    /// From now on the network loses packets to this host, or delivers them again.
    fn lose_what_comes(&self, lost: bool) -> Result<()> {
        ip(&format!("neighbour {} dev {}", misdirected(&self.actor, lost), self.cable))
    }

    /// From now on the network loses packets from this host, or delivers them again.
    fn lose_what_goes(&self, lost: bool) -> Result<()> {
        ip(&format!("-n {} neighbour {} dev cable", self.name, misdirected(&self.learner, lost)))
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        // This also removes the cable.
        let _ = ip(&format!("netns delete {}", self.name));
    }
}

/// Packets to a hardware address that no host has are lost without an error.
fn misdirected(address: &str, lost: bool) -> String {
    match lost {
        true => format!("replace {address} lladdr 02:00:00:00:00:99 nud permanent"),
        false => format!("delete {address}"),
    }
}

fn ip(arguments: &str) -> Result<()> {
    let output = Command::new("ip").args(arguments.split(' ')).output();
    let output = output.context("cannot start `ip`: Debian's package is iproute2")?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "ip {arguments}: {said}");
    Ok(())
}

/// Cuts the network, waits until both sides have closed the connection, mends it, and checks that nothing was lost.
async fn a_partition_heals(number: u8, cut: impl Fn(&Host, bool) -> Result<()>) -> Result<()> {
    let host = Host::new(number)?;
    let mut system = System::new(&[&SMALL[..], &["--address", &host.learner, "--insecure"]].concat())?;
    system.host.clone_from(&host.learner);
    system.start_learner(LIMIT).await?;
    let mut actor = system.start_actor_on(&host.name)?;
    trains_on(&mut system, "the actor's unrolls are trained on").await?;

    cut(&host, true)?;
    let deadline = Instant::now() + NOTICED;
    actor.until_log_holds("no connection to the learner", NOTICED).await?;
    let lost = |status: &comic_proto::v1::Status| status.actors.is_some_and(|actors| actors.lost == 1);
    let left = deadline.saturating_duration_since(Instant::now());
    system.until("the learner gives the actor up", left, |status| lost(status).then_some(())).await?;
    cut(&host, false)?;

    actor.until_log_holds("reconnected to the learner", LIMIT).await?;
    trains_on(&mut system, "the actor's unrolls are trained on again").await?;
    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}

#[tokio::test]
async fn a_network_that_is_cut_heals() -> Result<()> {
    a_partition_heals(1, |host, lost| {
        host.lose_what_comes(lost)?;
        host.lose_what_goes(lost)
    })
    .await
}

#[tokio::test]
async fn a_network_that_loses_packets_of_the_actor_heals() -> Result<()> {
    a_partition_heals(2, Host::lose_what_goes).await
}

#[tokio::test]
async fn a_network_that_loses_packets_of_the_learner_heals() -> Result<()> {
    a_partition_heals(3, Host::lose_what_comes).await
}
