//! How much of the learner all peers together may use.

use std::time::Duration;

use clap::Args;

/// The limits of the service. Peers beyond a limit are refused and counted; the others are not disturbed.
#[derive(Clone, Debug, Args)]
pub struct ConnectionLimits {
    /// Actors at once; further actors are told to try again later. The limit of connections is twice this number plus 64.
    #[arg(long, value_name = "N", default_value_t = 4096, value_parser = positive, help_heading = "Limits")]
    pub max_actors: usize,
    /// Connections from one address, or from one IPv6 network of 64 bits; further connections are closed at once. Calls in
    /// flight from one address are limited to four times this number [default: 1024, but at most half of all connections].
    #[arg(long, value_name = "N", value_parser = positive, help_heading = "Limits")]
    pub max_connections_per_address: Option<usize>,
    /// Calls in flight, including streams, of which an actor has two; further calls are refused.
    #[arg(long, value_name = "N", default_value_t = 16_384, value_parser = positive, help_heading = "Limits")]
    pub max_requests: usize,
    /// Time from the start of a connection to its first accepted call, health checks excluded, s. Then the connection is closed.
    #[arg(long, value_name = "SECONDS", default_value = "30", value_parser = seconds, help_heading = "Limits")]
    pub authentication_timeout: Duration,
    /// Age at which a connection must be made anew, s, so that a certificate that is no longer accepted goes out of use. Each
    /// connection gets an age within a tenth of it.
    #[arg(long, value_name = "SECONDS", default_value = "3600", value_parser = seconds, help_heading = "Limits")]
    pub max_connection_age: Duration,
    /// Bytes of a message to the learner [default: those of an unroll, at least 1 MiB].
    #[arg(long, value_name = "BYTES", value_parser = positive, help_heading = "Limits")]
    pub max_message_bytes: Option<usize>,
    /// Bytes of messages that were read and wait for a place in a batch, of all actors together; further messages stay unread.
    #[arg(long, value_name = "BYTES", default_value_t = INGEST, value_parser = positive, help_heading = "Limits")]
    pub max_ingest_bytes: usize,
    /// Bytes that a stream may have unread [default: those of an unroll]. Distant actors need more: this many bytes arrive in a
    /// round trip.
    #[arg(long, value_name = "BYTES", value_parser = clap::value_parser!(u32).range(65_535..1 << 31), help_heading = "Limits")]
    pub max_unread_bytes: Option<u32>,
}

/// Room for more than a thousand of the paper's unrolls.
const INGEST: usize = 256 * 1024 * 1024;
/// One machine, or one address that many machines share, has hundreds of actors and not thousands.
const CONNECTIONS_PER_ADDRESS: usize = 1024;
/// An actor has two streams, and at its start two more calls: `Join`, and one that fetches an asset.
const CALLS_PER_CONNECTION: usize = 4;

impl Default for ConnectionLimits {
    fn default() -> Self {
        Self {
            max_actors: 4096,
            max_connections_per_address: None,
            max_requests: 16_384,
            authentication_timeout: Duration::from_secs(30),
            max_connection_age: Duration::from_secs(3600),
            max_message_bytes: None,
            max_ingest_bytes: INGEST,
            max_unread_bytes: None,
        }
    }
}

impl ConnectionLimits {
    /// Connections at once, from all addresses. An actor that reconnects leaves its old connection open for a while, and status
    /// requests need connections too.
    pub fn max_connections(&self) -> usize {
        self.max_actors.saturating_mul(2).saturating_add(64)
    }

    /// Connections at once from one address.
    pub(crate) fn connections_per_address(&self) -> usize {
        self.max_connections_per_address.unwrap_or_else(|| (self.max_connections() / 2).min(CONNECTIONS_PER_ADDRESS))
    }

    /// Calls in flight from one address.
    pub(crate) fn calls_per_address(&self) -> usize {
        self.connections_per_address().saturating_mul(CALLS_PER_CONNECTION)
    }
}

/// At least a second, and at most what a jittered age cannot overflow.
fn seconds(text: &str) -> Result<Duration, String> {
    match text.parse() {
        Ok(number @ 1..=0xffff_ffff_u32) => Ok(Duration::from_secs(number.into())),
        _ => Err("must be a number of seconds, at least 1".into()),
    }
}

fn positive(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(number @ 1..=0xffff_ffff) => Ok(number),
        _ => Err("must be a number of at least 1".into()),
    }
}
