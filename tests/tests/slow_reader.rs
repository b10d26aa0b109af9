//! An actor at the end of a slow line gets whole versions, each newer than the last, and delays no one.

use anyhow::{Context as _, Result, ensure};
use comic_proto::v1::learner_client::LearnerClient;
use comic_proto::v1::{JoinRequest, WatchRequest};
use comic_proto::{Access, PROTOCOL_VERSION};
use comic_tests::relay::Relay;
use comic_tests::steps::{LIMIT, leaves, parameters_arrive, the_accounting_balances_at_the_end, trains_on};
use comic_tests::system::{SMALL, System};

/// At this rate a version of the small policy takes seconds, and the learner publishes dozens of versions meanwhile.
const BYTES_PER_SECOND: f64 = 100_000.0;
const VERSIONS: usize = 3;
/// Bytes: the default of RFC 9113.
const WINDOW: u32 = 65_535;

#[tokio::test]
async fn a_slow_reader_gets_whole_versions_and_delays_no_one() -> Result<()> {
    let mut system = System::new(&SMALL)?;
    system.start_learner(LIMIT).await?;
    let actor = system.start_actor()?;
    trains_on(&mut system, "the actor's unrolls are trained on").await?;

    let relay = Relay::start(system.address(), BYTES_PER_SECOND).await?;
    let reading = tokio::spawn(read(relay.url.clone()));
    parameters_arrive(&mut system, "the other gets new parameters all the time").await?;
    let versions = tokio::time::timeout(LIMIT, reading).await.context("the slow reader gets no versions")???;
    ensure!(versions.is_sorted_by(|one, next| one < next), "a version is not newer than the last: {versions:?}");
    let (first, last) = (versions[0], versions[VERSIONS - 1]);
    ensure!(last - first > VERSIONS as u64, "the reader skipped no version, so it was not slow: {versions:?}");

    leaves(actor).await?;
    the_accounting_balances_at_the_end(system).await
}

/// Reads the first whole versions.
async fn read(url: String) -> Result<Vec<u64>> {
    // The flow-control windows are too small for several versions.
    let endpoint =
        Access::default().endpoint(&url)?.initial_stream_window_size(WINDOW).initial_connection_window_size(WINDOW);
    let mut client = LearnerClient::new(endpoint.connect().await?);
    let request = JoinRequest { incarnation: 1, protocol: PROTOCOL_VERSION, ..JoinRequest::default() };
    let actor = client.join(request).await?.into_inner().actor;
    let mut pieces = client.watch_parameters(WatchRequest { actor, incarnation: 1 }).await?.into_inner();
    let (mut versions, mut read) = (Vec::new(), 0);
    while versions.len() < VERSIONS {
        let piece = pieces.message().await?.context("no more parameters")?;
        read = if piece.offset == 0 { 0 } else { read };
        ensure!(
            piece.offset == read,
            "a piece of version {} begins at {} and not at {read}",
            piece.version,
            piece.offset
        );
        read += piece.data.len() as u64;
        if read == piece.total {
            versions.push(piece.version);
        }
    }
    Ok(versions)
}
