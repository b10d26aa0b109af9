//! A slow line to the learner.

use std::time::Duration;

use anyhow::{Context, Result};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until};

/// Bytes of one write: small, so that nothing comes in bursts.
const PIECE: usize = 4096;

/// Carries connections to the learner, and a limited number of bytes a second back. Dropping it ends the connections.
pub struct Relay {
    /// The URL at which it listens.
    pub url: String,
    accepting: JoinHandle<()>,
}

impl Relay {
    /// Starts a relay to `learner`, given as `host:port`.
    ///
    /// # Errors
    /// When there is no free port.
    pub async fn start(learner: String, bytes_per_second: f64) -> Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0").await.context("no port for the relay")?;
        let url = format!("http://{}", listener.local_addr()?);
        let accepting = tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                let Ok(server) = TcpStream::connect(&learner).await else { continue };
                let ((mut from_client, to_client), (from_server, mut to_server)) =
                    (client.into_split(), server.into_split());
                tokio::spawn(async move { tokio::io::copy(&mut from_client, &mut to_server).await });
                tokio::spawn(carry(from_server, to_client, bytes_per_second));
            }
        });
        Ok(Self { url, accepting })
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.accepting.abort();
    }
}

async fn carry(mut from: impl AsyncRead + Unpin, mut to: impl AsyncWrite + Unpin, bytes_per_second: f64) -> Result<()> {
    let (mut piece, mut free) = ([0; PIECE], Instant::now());
    loop {
        let read = from.read(&mut piece).await?;
        if read == 0 {
            return Ok(());
        }
        free = free.max(Instant::now()) + Duration::from_secs_f64(read as f64 / bytes_per_second);
        sleep_until(free).await;
        to.write_all(&piece[..read]).await?;
    }
}
