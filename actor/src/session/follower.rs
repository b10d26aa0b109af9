//! Follows a learner's newest checkpoint, without joining as an actor.

use std::collections::HashMap;
use std::path::PathBuf;
use std::time::Duration;

use comic_experiment::Experiment;
use comic_proto::v1::{Asset, Checkpoint, CheckpointReply, CheckpointRequest};
use comic_proto::{Access, chain, distrusted};
use tokio::sync::watch;
use tonic::{Code, Request, Status};

use super::assets;
use super::backoff::Backoff;
use super::connection::{CALL, Failure, check, connect, describe, unwelcome};
use crate::Error;

/// Between two questions. A learner whose run is over answers for at least 1.5 s more.
const INTERVAL: Duration = Duration::from_millis(500);
/// Most bytes of an experiment and of a policy.
const EXPERIMENT_LIMIT: u64 = 16 << 20;
const POLICY_LIMIT: u64 = 4 << 30;

/// A learner whose checkpoints are followed.
#[derive(Clone, Debug)]
pub struct Follower {
    /// For instance `http://host:7070`.
    learner: String,
    access: Access,
    /// Directory of the asset cache; the user's cache directory when absent.
    cache: Option<PathBuf>,
    /// How long to go on while the learner does not answer; for ever when absent.
    give_up_after: Option<Duration>,
}

/// A checkpoint's content.
#[derive(Clone, Debug)]
pub struct Fetched {
    /// The experiment.
    pub experiment: Experiment,
    /// Parameters of the online policy (safetensors).
    pub policy: Vec<u8>,
    /// In transfer: the file of the frozen low level.
    pub low_level: Option<Vec<u8>>,
    /// The file of each source of clips, if they were wanted.
    pub assets: HashMap<String, PathBuf>,
}

impl Follower {
    /// A follower of the learner at `learner`.
    ///
    /// # Errors
    /// [`Error::Access`], when address, certificates or token cannot be used.
    pub fn new(
        learner: String,
        access: Access,
        cache: Option<PathBuf>,
        give_up_after: Option<Duration>,
    ) -> Result<Self, Error> {
        check(&learner, &access)?;
        Ok(Self { learner, access, cache, give_up_after })
    }

    /// Shows the newest checkpoint until the run is over, and none while there is no connection. A lost connection is no
    /// error.
    ///
    /// # Errors
    /// When the learner does not accept this process, is of another release, or does not answer for too long.
    pub async fn follow(&self, newest: &watch::Sender<Option<Checkpoint>>) -> Result<(), Error> {
        let mut backoff = Backoff::new(self.give_up_after);
        let mut accepted = false;
        loop {
            let mut answered = false;
            let ended = self.ask(newest, &mut answered).await;
            if answered {
                accepted = true;
                backoff.answered();
                backoff.reset();
            }
            newest.send_replace(None);
            let Err(failure) = ended else { return Ok(()) };
            let failure = if accepted { failure.transient() } else { failure };
            backoff.retry(&self.learner, failure).await?;
        }
    }

    /// Asks on one connection until the run is over.
    async fn ask(&self, newest: &watch::Sender<Option<Checkpoint>>, answered: &mut bool) -> Result<(), Failure> {
        let mut client = connect(&self.learner, &self.access).await?;
        loop {
            let mut request = Request::new(CheckpointRequest {});
            request.set_timeout(CALL);
            let reply = client.get_checkpoint(request).await.map_err(|status| self.judge(status))?;
            if !std::mem::replace(answered, true) {
                tracing::info!(learner = self.learner, "following the learner's checkpoints");
            }
            let CheckpointReply { checkpoint, run_over } = reply.into_inner();
            newest.send_if_modified(|newest| {
                let changed = *newest != checkpoint;
                *newest = checkpoint;
                changed
            });
            if run_over {
                return Ok(());
            }
            tokio::time::sleep(INTERVAL).await;
        }
    }

    /// Fetches the content of a checkpoint that the learner has shown, and the files of its clips if they are `wanted`.
    pub(crate) async fn fetch(
        &self,
        checkpoint: &Checkpoint,
        wanted: impl Fn(&Experiment) -> bool,
    ) -> Result<Fetched, Failure> {
        let mut client = connect(&self.learner, &self.access).await.map_err(Failure::transient)?;
        let file = |asset: &Option<Asset>| asset.clone().ok_or_else(|| Failure::Lost("it names no files".to_owned()));
        let (experiment, policy) = (file(&checkpoint.experiment)?, file(&checkpoint.policy)?);
        let experiment = assets::read(&mut client, &experiment, EXPERIMENT_LIMIT).await?;
        let experiment = Experiment::from_toml("the checkpoint's experiment", &String::from_utf8_lossy(&experiment))
            .map_err(|error| Failure::Fatal(error.into()))?;
        let wants_clips = wanted(&experiment);
        let is_low_level = |asset: &Asset| experiment.transfer.is_on() && asset.source == experiment.transfer.low_level;
        let needed = |asset: &&Asset| wants_clips || is_low_level(asset);
        let needed: Vec<Asset> = checkpoint.assets.iter().filter(needed).cloned().collect();
        let assets = assets::fetch(&mut client, &needed, self.cache.as_deref()).await?;
        let low_level = assets::low_level(&experiment, &assets).map_err(Failure::Fatal)?;
        let policy = assets::read(&mut client, &policy, POLICY_LIMIT).await?;
        Ok(Fetched { experiment, policy, low_level, assets })
    }

    fn judge(&self, status: Status) -> Failure {
        match status.code() {
            Code::Unauthenticated => unwelcome(&self.learner, status.message().to_owned()),
            Code::Unimplemented | Code::PermissionDenied => {
                Failure::Fatal(Error::Refused { url: self.learner.clone(), message: describe(&status) })
            }
            _ if distrusted(&status) => unwelcome(&self.learner, chain(&status)),
            _ => status.into(),
        }
    }
}
