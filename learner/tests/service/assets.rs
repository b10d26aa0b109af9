//! Assets: `Join` announces them, actors fetch them by hash and verify them.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;
use std::sync::Arc;

use crate::support::World;
use bytes::Bytes;
use comic_clips::Asset;
use comic_learner::checkpoint::{Name, Snapshot, Store};
use comic_learner::service::offer::Offer;
use comic_learner::train::writer::Writer;
use comic_proto::v1::{AssetRequest, CheckpointReply, CheckpointRequest};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;
use sha2::{Digest as _, Sha256};
use tonic::{Code, Status};

fn asset(folder: &Path, name: &str, size: usize) -> Asset {
    let contents: Vec<u8> = (0..size).map(|place| (place * 31 % 251) as u8).collect();
    let path = folder.join(name);
    std::fs::write(&path, &contents).unwrap();
    Asset { source: format!("clips/{name}"), path, sha256: Sha256::digest(&contents).into(), size: size as u64 }
}

async fn fetch(world: &World, sha256: Vec<u8>) -> Result<Vec<u8>, Status> {
    let mut pieces = world.client().await.fetch_asset(AssetRequest { sha256 }).await?.into_inner();
    let mut contents = Vec::new();
    while let Some(piece) = pieces.message().await? {
        assert!(piece.data.len() <= 256 * 1024);
        contents.extend(&piece.data);
    }
    Ok(contents)
}

#[tokio::test]
async fn a_fetched_asset_has_the_announced_hash_and_size() {
    let folder = tempfile::tempdir().unwrap();
    let assets = [("walk.h5", 700_001), ("run.h5", 256 * 1024), ("empty.h5", 0)];
    let assets = assets.map(|(name, size)| asset(folder.path(), name, size)).to_vec();
    let world = World::start_with(8, assets).await;
    let announced = world.actor(70).await.reply.assets;
    assert_eq!(
        announced.iter().map(|asset| asset.source.as_str()).collect::<Vec<_>>(),
        ["clips/walk.h5", "clips/run.h5", "clips/empty.h5"]
    );
    for asset in announced {
        let contents = fetch(&world, asset.sha256.clone()).await.unwrap();
        assert_eq!(contents.len() as u64, asset.size);
        assert_eq!(Sha256::digest(&contents)[..], asset.sha256[..]);
    }
}

#[tokio::test]
async fn an_unknown_hash_is_not_found() {
    let world = World::start().await;
    for hash in [vec![0xab; 32], Vec::new(), vec![0; 100_000]] {
        let refused = fetch(&world, hash).await.unwrap_err();
        assert_eq!(refused.code(), Code::NotFound);
    }
    assert!(fetch(&world, vec![0xab; 32]).await.unwrap_err().message().contains("abab"));
}

#[tokio::test]
async fn an_asset_that_shrank_or_vanished_after_the_start_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let (shrunk, gone) = (asset(folder.path(), "shrunk.h5", 600_000), asset(folder.path(), "gone.h5", 10));
    let world = World::start_with(8, vec![shrunk.clone(), gone.clone()]).await;
    std::fs::write(&shrunk.path, b"little").unwrap();
    std::fs::remove_file(&gone.path).unwrap();
    for asset in [shrunk, gone] {
        let refused = fetch(&world, asset.sha256.to_vec()).await.unwrap_err();
        assert_eq!(refused.code(), Code::DataLoss);
        assert!(refused.message().contains(&asset.source), "{}", refused.message());
    }
}

/// A checkpoint after so many updates, written to `folder`.
fn offer(folder: &Path, updates: u64, policy: &str) -> Offer {
    let random = serde_json::to_string(&Pcg64::seed_from_u64(1)).unwrap();
    let progress = format!(
        r#"{{"format": 2, "run": 7, "epoch": 3, "updates": {updates}, "gradient_steps": 40, "environment_steps": 70, "seconds": 2.5, "version": 9,
            "random": {random}}}"#
    );
    let mut snapshot = Snapshot::default();
    for (name, text) in [("progress.json", progress.as_str()), ("experiment.toml", ""), ("policy.safetensors", policy)]
    {
        std::fs::write(folder.join(name), text).unwrap();
        snapshot.parts.insert(name.into(), text.into());
    }
    Offer::new(folder, &snapshot).unwrap()
}

#[tokio::test]
async fn an_evaluator_learns_of_the_newest_checkpoint_and_fetches_its_files() {
    let folder = tempfile::tempdir().unwrap();
    let world = World::start_with(8, vec![asset(folder.path(), "walk.h5", 9)]).await;
    let mut client = world.client().await;
    let mut ask = async || client.get_checkpoint(CheckpointRequest {}).await.unwrap().into_inner();
    assert_eq!(ask().await, CheckpointReply::default(), "before the first checkpoint");
    world.service.trainer().offer(offer(folder.path(), 3, "older"));
    let older = ask().await.checkpoint.unwrap();
    world.service.trainer().offer(offer(folder.path(), 4, "newer"));
    let newer = ask().await.checkpoint.unwrap();
    assert_eq!((newer.run, newer.learner_epoch, newer.version, newer.updates), (7, 3, 9, 4));
    assert_eq!((newer.environment_steps, newer.seconds, newer.assets.len()), (70, 2.5, 1));
    assert_eq!(world.service.trainer().held_checkpoint(), None, "nobody has fetched one");
    assert_eq!(fetch(&world, newer.policy.unwrap().sha256).await.unwrap(), b"newer");
    assert_eq!(world.service.trainer().held_checkpoint(), Some(Name::Updates(4)));
    assert_eq!(fetch(&world, newer.experiment.unwrap().sha256).await.unwrap(), b"");
    assert_eq!(fetch(&world, older.policy.unwrap().sha256).await.unwrap_err().code(), Code::NotFound);
    // As long as its evaluation may come, training does not remove it.
    let run = tempfile::tempdir().unwrap();
    let store = Store::open(run.path(), 1).unwrap();
    let writer = Writer::start(store, world.service.trainer()).unwrap();
    for updates in [4, 5, 6] {
        writer.write(Name::Updates(updates), Arc::default()).unwrap();
    }
    writer.finish().unwrap();
    let kept = |updates| run.path().join(format!("checkpoints/checkpoint-{updates:010}")).exists();
    assert_eq!([4, 5, 6].map(kept), [true, false, true]);
    world.publisher.publish(1, &Bytes::from_static(b"parameters"));
    world.publisher.end_run();
    assert!(ask().await.run_over);
}
