//! `comic-learner health`: asks whether a learner serves.

use std::io::Write as _;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use comic_proto::{Access, chain, no_connection};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::error::{Error, Result};

/// Asks a learner by the gRPC health protocol. No token is needed, but a certificate if the learner requires them. Exits with
/// 0 if it serves, and with 1 in all other cases.
#[derive(Clone, Debug, Args)]
pub struct Health {
    /// The learner's address.
    #[arg(long, value_name = "URL", env = "COMIC_LEARNER", default_value = "http://127.0.0.1:7070")]
    pub learner: String,
    /// Seconds within which it must answer.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=600))]
    pub timeout: u64,
    /// How to reach it.
    #[command(flatten)]
    pub access: Access,
}

impl Health {
    /// Asks, and prints the answer.
    pub fn run(&self) -> ExitCode {
        match self.ask() {
            Ok(()) => {
                // An error is not important: stdout may be closed.
                let _ = writeln!(std::io::stdout(), "serving");
                ExitCode::SUCCESS
            }
            Err(error) => {
                eprintln!("comic-learner: {}", chain(&error));
                ExitCode::FAILURE
            }
        }
    }

    fn ask(&self) -> Result<()> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(Error::system("cannot start tokio"))?;
        runtime.block_on(async {
            let limit = Duration::from_secs(self.timeout);
            let answer = tokio::time::timeout(limit, self.check()).await;
            answer.map_err(|_| Error::NoAnswer(format!("no answer in {limit:?}")))?
        })
    }

    async fn check(&self) -> Result<()> {
        let channel = self.access.endpoint(&self.learner)?.connect().await;
        let channel =
            channel.map_err(|error| Error::NoAnswer(format!("{}: {}", self.learner, no_connection(&error))))?;
        let request = HealthCheckRequest { service: "comic.v1.Learner".into() };
        let answer = HealthClient::new(channel).check(request).await;
        let answer = answer.map_err(|status| Error::NoAnswer(chain(&status)))?.into_inner();
        match answer.status() {
            ServingStatus::Serving => Ok(()),
            other => Err(Error::NoAnswer(format!("{} is {}", self.learner, other.as_str_name()))),
        }
    }
}
