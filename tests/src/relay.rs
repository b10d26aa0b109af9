//! A slow way to the learner.

use std::time::Duration;

use anyhow::{Context, Result};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until};

/// A little at a time, so that nothing comes in bursts.
const PIECE: usize = 4096;

/// Carries connections to the learner, and only so many bytes a second of each back; ends when dropped.
pub struct Relay {
    /// Where it listens.
    pub url: String,
    accepting: JoinHandle<()>,
}

impl Relay {
    /// Begins to carry connections to `learner`, as `host:port`.
    ///
    /// # Errors
    /// No port to be had.
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
