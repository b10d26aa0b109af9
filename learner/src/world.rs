//! The learners that train one run together, in the terms of torch.distributed: each has a *rank*, and there are *world size* of
//! them. Each takes its share of every batch.
//!
//! # What is reduced
//! A loss is a sum over the steps of the whole batch, or a mean over them. A rank computes its *share*: the sum over its own steps,
//! divided by the number of steps of all ranks. The shares of all ranks, and so their gradients, add up to the whole. In a gradient
//! step this passes between ranks:
//!
//! - Three numbers of each step are gathered: its advantage, its return, and its task, which also says whether it is valid. Means
//!   divide by the number of valid steps. V-MPO's best half, its softmax and its temperature are of the whole batch, so each rank
//!   computes them from all advantages, and then takes the weights of its own steps. The returns are for the variance that the
//!   report explains.
//! - The gradients are summed, with the losses for the report, before their norm is limited and Adam steps. Each rank takes the
//!   same step from the same sum, so parameters stay equal, bit for bit.
//!
//! These are two operations, because each costs the time to reach the slowest rank.
//!
//! Besides, the sums behind the normaliser's statistics are summed. Before each batch the ranks say what they have
//! ([`World::exchange`]), and all decide the same. Rank 0 gets the others' metrics and accounts, and sends its checkpoint at the start.
//!
//! # How
//! c10d's gloo moves CPU memory over TCP. Tensors of another device pass through the CPU. The connections are neither encrypted
//! nor authenticated, so they belong on a private network.
//!
//! A learner alone is a world of one rank, for which every operation is nothing. A rank that ends closes its connections; the
//! operations of all others then fail, and all ranks end.

mod c10d;

use std::net::{IpAddr, SocketAddr, TcpListener, UdpSocket};
use std::sync::Arc;
use std::time::Duration;

use parking_lot::Mutex;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tch::{Device, Tensor};

/// How long ranks wait until all have met, and then for each other at the start and at the end. A cluster may start them minutes apart,
/// and one may read many clips.
pub const MEETING: Duration = Duration::from_secs(600);
/// How long they wait for each other in between, for a rank that is connected and silent. It is longer than an update takes.
pub const SILENCE: Duration = Duration::from_secs(120);
/// Most bytes that a rank may say at once.
const LONGEST: i64 = 256 << 20;

/// Why ranks cannot go on together.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The other ranks were not reached.
    #[error("rank {rank} cannot meet the other {} ranks at {address}: {reason}", size - 1)]
    Meeting {
        /// This rank.
        rank: usize,
        /// The number of ranks.
        size: usize,
        /// The rendezvous.
        address: SocketAddr,
        /// What c10d says.
        reason: String,
    },
    /// Rank 0 does not listen at the rendezvous.
    #[error(
        "rank {rank} cannot reach rank 0 at --rendezvous {rendezvous}: it must be an address at which rank 0 listens"
    )]
    Unreachable {
        /// This rank.
        rank: usize,
        /// The rendezvous, as given.
        rendezvous: String,
        /// Why the last attempt failed.
        source: std::io::Error,
    },
    /// Rank 0 was started with another world size.
    #[error(
        "rank 0 has --world-size {of_first}, and rank {rank} {size}: give all ranks the same, or start this one again if rank 0 is of \
         a former run that ends"
    )]
    Sizes {
        /// This rank.
        rank: usize,
        /// Its world size.
        size: usize,
        /// That of rank 0.
        of_first: i32,
    },
    /// A rank ended, or does not answer.
    #[error(
        "rank {rank} lost another rank, so the update cannot be finished: {reason}. When all ranks are started again, they continue \
         from the newest checkpoint"
    )]
    Lost {
        /// This rank.
        rank: usize,
        /// What c10d says.
        reason: String,
    },
    /// What a rank said cannot be understood.
    #[error("rank {rank} said what cannot be understood: start all ranks from the same release")]
    Message {
        /// The rank that said it.
        rank: usize,
        /// What is wrong with it.
        source: serde_json::Error,
    },
    /// A rank said more than is accepted.
    #[error(
        "a rank announces {bytes} bytes, and at most {LONGEST} are accepted: start all ranks from the same release"
    )]
    TooLong {
        /// As announced.
        bytes: i64,
    },
    /// libtorch refused an operation.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}

/// A result with this module's [`enum@Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// The ranks of a run, as one of them sees them; a handle that can be cloned. All ranks call the same operations in the same order.
#[derive(Clone, Debug)]
pub struct World {
    rank: usize,
    size: usize,
    /// None for a learner alone.
    group: Option<Arc<Mutex<c10d::Group>>>,
}

impl World {
    /// A learner alone.
    pub fn alone() -> Self {
        Self { rank: 0, size: 1, group: None }
    }

    /// Meets the other ranks at the address where rank 0 listens, on this `listener`. Blocks until all are there.
    ///
    /// # Errors
    /// [`Error::Meeting`] after this `patience`; [`Error::Sizes`].
    pub fn meet(
        rank: usize,
        size: usize,
        address: SocketAddr,
        listener: Option<TcpListener>,
        patience: Duration,
    ) -> Result<Self> {
        if size <= 1 {
            return Ok(Self::alone());
        }
        let failed = |reason: String| Error::Meeting { rank, size, address, reason };
        let own = address_towards(address).map_err(|error| failed(error.to_string()))?;
        let meeting = c10d::Meeting { rank, size, address, listener, own, patience };
        let group = c10d::Group::meet(meeting).map_err(|reason| match reason {
            c10d::NotMet::OtherSize(of_first) => Error::Sizes { rank, size, of_first },
            c10d::NotMet::Failed(reason) => failed(reason),
        })?;
        let world = Self { rank, size, group: Some(Arc::new(Mutex::new(group))) };
        world.wait_for(MEETING);
        Ok(world)
    }

    /// This rank.
    pub fn rank(&self) -> usize {
        self.rank
    }

    /// The number of ranks.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Whether this is the rank that decides, and that writes the run's directory.
    pub fn is_first(&self) -> bool {
        self.rank == 0
    }

    /// How often this rank has spoken with the others: each time costs the time to reach the slowest of them.
    pub fn operations(&self) -> u64 {
        self.group.as_ref().map_or(0, |group| group.lock().operations())
    }

    /// From now on an operation waits so long for the other ranks. At first it is [`MEETING`].
    pub fn wait_for(&self, patience: Duration) {
        if let Some(group) = &self.group {
            group.lock().wait_for(patience);
        }
    }

    /// Replaces each tensor by its sum over all ranks. The tensors carry no gradient. They have the same shapes on all ranks, one
    /// device, and one element type.
    ///
    /// # Errors
    /// [`Error::Lost`].
    pub fn sum<'a>(&self, tensors: impl IntoIterator<Item = &'a mut Tensor>) -> Result<()> {
        let Some(group) = &self.group else { return Ok(()) };
        // One operation, because each costs the time to reach the slowest rank.
        let tensors: Vec<&mut Tensor> = tensors.into_iter().collect();
        let flat: Vec<Tensor> = tensors.iter().map(|tensor| tensor.detach().reshape([-1])).collect();
        let lengths: Vec<i64> = flat.iter().map(|tensor| tensor.size()[0]).collect();
        let flat = Tensor::f_cat(&flat, 0)?;
        let sum = flat.to_device(Device::Cpu);
        group.lock().sum(&sum).map_err(|reason| self.lost(reason))?;
        let sums = sum.to_device(flat.device()).f_split_with_sizes(lengths.as_slice(), 0)?;
        for (tensor, sum) in tensors.into_iter().zip(sums) {
            *tensor = sum.f_view(tensor.size().as_slice())?;
        }
        Ok(())
    }

    /// The tensors of all ranks in the order of the ranks, joined along dimension 0. They have the same shape. No gradient flows back.
    ///
    /// # Errors
    /// [`Error::Lost`].
    pub fn gather(&self, tensor: &Tensor) -> Result<Tensor> {
        let Some(group) = &self.group else { return Ok(tensor.detach()) };
        let own = tensor.detach().to_device(Device::Cpu).contiguous();
        let mut size = own.size();
        if let Some(first) = size.first_mut() {
            *first *= self.size as i64;
        }
        let all = Tensor::f_empty(size.as_slice(), (own.kind(), Device::Cpu))?;
        group.lock().gather(&own, &all).map_err(|reason| self.lost(reason))?;
        Ok(all.to_device(tensor.device()))
    }

    /// This rank's part of a tensor that has the form of [`gather`](Self::gather)'s.
    pub fn own_part(&self, all: &Tensor) -> Tensor {
        let length = all.size()[0] / self.size as i64;
        all.narrow(0, self.rank as i64 * length, length)
    }

    /// What every rank says, in the order of the ranks.
    ///
    /// # Errors
    /// [`Error::Lost`]; [`Error::Message`] when a rank runs another release.
    pub fn exchange<T: Serialize + DeserializeOwned>(&self, own: T) -> Result<Vec<T>> {
        if self.group.is_none() {
            return Ok(vec![own]);
        }
        let own = serde_json::to_vec(&own).map_err(|source| Error::Message { rank: self.rank, source })?;
        let lengths = Vec::<i64>::try_from(self.gather(&Tensor::from_slice(&[own.len() as i64]))?)?;
        let longest = lengths.iter().copied().max().unwrap_or_default();
        if longest > LONGEST || lengths.iter().any(|length| *length < 0) {
            return Err(Error::TooLong { bytes: longest });
        }
        let mut padded = own;
        padded.resize(longest as usize, 0);
        let all = Vec::<u8>::try_from(self.gather(&Tensor::from_slice(&padded))?)?;
        let said = all.chunks(longest.max(1) as usize).zip(lengths).enumerate();
        said.map(|(rank, (bytes, length))| {
            serde_json::from_slice(&bytes[..length as usize]).map_err(|source| Error::Message { rank, source })
        })
        .collect()
    }

    /// The bytes of rank 0, which are as many as `bytes` has on every rank.
    ///
    /// # Errors
    /// [`Error::Lost`].
    pub fn broadcast(&self, bytes: Vec<u8>) -> Result<Vec<u8>> {
        let Some(group) = &self.group else { return Ok(bytes) };
        let tensor = Tensor::f_from_slice(&bytes)?;
        group.lock().broadcast(&tensor).map_err(|reason| self.lost(reason))?;
        Ok(Vec::<u8>::try_from(tensor)?)
    }

    /// The address of this machine that the other ranks reach, towards `rendezvous`.
    ///
    /// # Errors
    /// When the system knows no way there.
    pub fn reachable_address(rendezvous: SocketAddr) -> std::io::Result<IpAddr> {
        address_towards(rendezvous)
    }

    fn lost(&self, reason: String) -> Error {
        Error::Lost { rank: self.rank, reason }
    }
}

/// The address that connections to `peer` come from. No packet is sent.
fn address_towards(peer: SocketAddr) -> std::io::Result<IpAddr> {
    let any: SocketAddr = if peer.is_ipv4() { ([0, 0, 0, 0], 0).into() } else { ([0u16; 8], 0).into() };
    let socket = UdpSocket::bind(any)?;
    socket.connect(peer)?;
    Ok(socket.local_addr()?.ip())
}
