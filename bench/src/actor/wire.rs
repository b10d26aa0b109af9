//! The path of an unroll from a worker into a batch.

use std::pin::Pin;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow, ensure};
use comic_actor::mailbox::Mailbox;
use comic_actor::session::{self, ExchangeLimits};
use comic_actor::worker::FinishedUnroll;
use comic_proto::v1::learner_server::{Learner, LearnerServer};
use comic_proto::v1::*;
use comic_proto::{Access, Expected, Field, Pieces, UnrollBuffer, UnrollLayout, UnrollShape, validate};
use comic_replay::{BatchOrder, Batcher, Config, Ledger, Outcome, Phase};
use futures::{Stream, StreamExt as _};
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status, Streaming};

use super::Subject;
use crate::figure::{Figure, Medians, interleave};

/// A segment has the unrolls of so many updates.
const UPDATES: usize = 2;

/// Session, loopback, validation and batcher share one thread, whose processor time is measured. The floor is the second
/// between two updates at one update a second.
pub(super) fn wire(subject: &Subject) -> Result<Figure> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().context("cannot start tokio")?;
    let (spec, experiment) = (subject.task.spec(), &subject.experiment);
    let layout = Arc::new(UnrollLayout::new(UnrollShape::new(spec, experiment)));
    let phase = Phase { epoch: 1, version: 1, oldest: 0 };
    let config = Config {
        unrolls: experiment.unroll.batch,
        max_staleness: experiment.max_versions_late(),
        ahead: experiment.unroll.ahead,
        order: BatchOrder::Arrival,
    };
    let batcher = Batcher::new(Arc::clone(&layout), config, phase, Ledger::new());
    let trainer = thread::spawn({
        let batcher = batcher.clone();
        move || {
            while let Some(batch) = batcher.next_batch() {
                batcher.trained(batch);
            }
        }
    });
    let reply = JoinReply {
        learner_epoch: 1,
        experiment: experiment.to_toml()?,
        task_spec: toml::to_string(spec)?,
        layout_hash: layout.hash().to_vec(),
        ..JoinReply::default()
    };
    let address = runtime.block_on(serve(Receiver { batcher: batcher.clone(), reply }))?;
    let unrolls = UPDATES * experiment.unroll.batch;
    let unroll = still_unroll(&layout);
    let medians = interleave(subject.budget, || {
        let elapsed = runtime.block_on(send(&address, &unroll, unrolls))?;
        Ok::<_, anyhow::Error>((elapsed.as_secs_f64() * 1000.0 / UPDATES as f64, 1000.0))
    });
    batcher.close();
    trainer.join().map_err(|_| anyhow!("the thread that takes batches panicked"))?;
    let Medians { value, floor } = medians?;
    let note = "ms of one core for the unrolls of one update (encode, loopback, decode, validate, batch); floor: the \
                second between updates, so the ratio is the share of an actor's time";
    Ok(Figure::new("actor.wire", "ms/update", Medians { value, floor }, note))
}

/// The calling thread's processor time, which other programs on the machine do not lengthen. Wall-clock time where the
/// kernel reports none.
enum Clock {
    Processor(Duration),
    Wall(Instant),
}

impl Clock {
    fn start() -> Self {
        processor_time().map_or_else(|| Self::Wall(Instant::now()), Self::Processor)
    }

    fn elapsed(&self) -> Duration {
        match self {
            Self::Processor(start) => processor_time().unwrap_or(*start).saturating_sub(*start),
            Self::Wall(start) => start.elapsed(),
        }
    }
}

/// The first number of Linux's `schedstat`: nanoseconds on a processor.
fn processor_time() -> Option<Duration> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    text.split_whitespace().next()?.parse().ok().map(Duration::from_nanos)
}

/// An unroll that passes validation.
fn still_unroll(layout: &UnrollLayout) -> FinishedUnroll {
    let mut buffer = UnrollBuffer::new(layout);
    for t in 0..layout.rows(Field::Valid) {
        buffer.row_mut(Field::Valid, t)[0] = 1.0;
    }
    let payload = buffer.into_bytes();
    FinishedUnroll {
        payload,
        learner_epoch: 1,
        version: 1,
        episodes: Vec::new(),
        environment: 0,
        task: 0,
        ticket: None,
    }
}

/// Processor time of this thread from the first unroll sent to the last acknowledgement.
async fn send(address: &str, unroll: &FinishedUnroll, unrolls: usize) -> Result<Duration> {
    let (_stop, stopped) = watch::channel(false);
    let options = session::JoinSettings {
        learner: address.to_string(),
        access: Access::default(),
        cache: None,
        name: None,
        threads: None,
        environments: None,
        give_up_after: None,
    };
    let joined = session::join(&options, stopped.clone()).await?;
    let (sender, receiver) = mpsc::channel(super::ENVIRONMENTS);
    let limits = ExchangeLimits { window: 2 * super::ENVIRONMENTS, parameters: 0, flush: Duration::ZERO };
    let begin = Clock::start();
    let session = tokio::spawn(joined.run(limits, receiver, Arc::new(Mailbox::default()), stopped));
    for _ in 0..unrolls {
        if sender.send(unroll.clone()).await.is_err() {
            break;
        }
    }
    drop(sender);
    let settled = session.await.context("the session panicked")??;
    ensure!(settled.taken == unrolls as u64, "not all of {unrolls} unrolls were taken: {settled:?}");
    Ok(begin.elapsed())
}

async fn serve(receiver: Receiver) -> Result<String> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let address = format!("http://{}", listener.local_addr()?);
    let limit = receiver.batcher.layout().message_limit();
    let service = LearnerServer::new(receiver).max_decoding_message_size(limit);
    // An unroll of 200 KB fits into the windows and frames. With a stream window of 256 KiB and the default frames of
    // 16 KiB the cost is five times as high.
    let router = tonic::transport::Server::builder()
        .initial_stream_window_size(512 * 1024)
        .initial_connection_window_size(1024 * 1024)
        .max_frame_size(256 * 1024)
        .add_service(service);
    tokio::spawn(router.serve_with_incoming(TcpListenerStream::new(listener)));
    Ok(address)
}

/// The learner's validation and batcher without its trainer.
struct Receiver {
    batcher: Batcher,
    reply: JoinReply,
}

type Reply<T> = Result<Response<T>, Status>;
type Messages<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

async fn take(batcher: &Batcher, message: UnrollMessage) -> Result<UnrollAck, Status> {
    let header = message.header.ok_or_else(|| Status::invalid_argument("no header"))?;
    let expected = Expected { clips: &[1], epoch: 1, newest_version: 1 };
    let payload = Pieces::from(message.payload);
    validate(batcher.layout(), &header, &payload, &expected)
        .map_err(|invalid| Status::invalid_argument(invalid.to_string()))?;
    let verdict = match batcher.insert(&header, payload).await {
        Outcome::Taken => Verdict::Taken,
        _ => Verdict::Invalid,
    };
    Ok(UnrollAck {
        sequence: header.sequence,
        verdict: verdict.into(),
        learner_epoch: 1,
        version: 1,
        ..UnrollAck::default()
    })
}

#[tonic::async_trait]
impl Learner for Receiver {
    async fn join(&self, request: Request<JoinRequest>) -> Reply<JoinReply> {
        let JoinRequest { incarnation, actor, .. } = request.into_inner();
        let joined = self
            .batcher
            .join(incarnation, actor)
            .map_err(|refused| Status::failed_precondition(refused.to_string()))?;
        Ok(Response::new(JoinReply { actor: joined.actor, ..self.reply.clone() }))
    }

    type SendUnrollsStream = Messages<UnrollAck>;
    async fn send_unrolls(&self, request: Request<Streaming<UnrollMessage>>) -> Reply<Self::SendUnrollsStream> {
        let batcher = self.batcher.clone();
        let acks = request.into_inner().then(move |message| {
            let batcher = batcher.clone();
            async move { take(&batcher, message?).await }
        });
        Ok(Response::new(Box::pin(acks)))
    }

    type WatchParametersStream = Messages<ParametersChunk>;
    async fn watch_parameters(&self, _request: Request<WatchRequest>) -> Reply<Self::WatchParametersStream> {
        Ok(Response::new(Box::pin(futures::stream::pending())))
    }

    type FetchAssetStream = Messages<AssetChunk>;
    async fn fetch_asset(&self, _request: Request<AssetRequest>) -> Reply<Self::FetchAssetStream> {
        Err(Status::not_found("no assets here"))
    }

    async fn get_checkpoint(&self, _request: Request<CheckpointRequest>) -> Reply<CheckpointReply> {
        Err(Status::unimplemented("no checkpoints here"))
    }

    async fn report_evaluation(&self, _request: Request<EvaluationReport>) -> Reply<EvaluationAck> {
        Ok(Response::new(EvaluationAck {}))
    }

    async fn get_status(&self, _request: Request<StatusRequest>) -> Reply<comic_proto::v1::Status> {
        Ok(Response::new(comic_proto::v1::Status::default()))
    }
}
