//! c10d's process group of gloo: see `c10d.cpp`.

#![allow(unsafe_code, reason = "calls C++ functions")]

use std::ffi::{CString, c_char, c_void};
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::os::fd::IntoRawFd;
use std::ptr::NonNull;
use std::time::Duration;

use tch::{Device, Tensor};

unsafe extern "C" {
    fn comic_world_meet(
        host: *const c_char,
        port: u16,
        listener: i32,
        address: *const c_char,
        rank: i32,
        size: i32,
        patience: i64,
        size_of_first: *mut i32,
        message: *mut c_char,
        room: usize,
    ) -> *mut c_void;
    fn comic_world_wait_for(group: *mut c_void, patience: i64);
    fn comic_world_sum(group: *mut c_void, tensor: *const c_void, message: *mut c_char, room: usize) -> bool;
    fn comic_world_gather(
        group: *mut c_void,
        tensor: *const c_void,
        all: *const c_void,
        message: *mut c_char,
        room: usize,
    ) -> bool;
    fn comic_world_broadcast(group: *mut c_void, tensor: *const c_void, message: *mut c_char, room: usize) -> bool;
    fn comic_world_leave(group: *mut c_void);
}

/// Where and how ranks meet.
pub(super) struct Meeting {
    pub(super) rank: usize,
    pub(super) size: usize,
    /// Where rank 0 listens.
    pub(super) address: SocketAddr,
    /// Rank 0's socket there.
    pub(super) listener: Option<TcpListener>,
    /// The address of this machine for connections to the other ranks.
    pub(super) own: IpAddr,
    /// How long to wait for the other ranks, there and in every operation.
    pub(super) patience: Duration,
}

/// Why ranks did not meet.
pub(super) enum NotMet {
    /// Rank 0 has this world size.
    OtherSize(i32),
    /// What c10d says.
    Failed(String),
}

impl From<String> for NotMet {
    fn from(reason: String) -> Self {
        Self::Failed(reason)
    }
}

/// The connections to all other ranks.
#[derive(Debug)]
pub(super) struct Group {
    group: NonNull<c_void>,
    /// Operations so far.
    operations: u64,
}

// SAFETY: the process group belongs to no thread. Its functions need `&mut self`, so they are called one after the other.
unsafe impl Send for Group {}

impl Group {
    /// # Errors
    /// Another size of rank 0; what c10d says.
    pub(super) fn meet(meeting: Meeting) -> Result<Self, NotMet> {
        let text = |address: IpAddr| CString::new(address.to_string()).map_err(|error| error.to_string());
        let (host, own) = (text(meeting.address.ip())?, text(meeting.own)?);
        let [rank, size] = [meeting.rank, meeting.size].map(i32::try_from);
        let (rank, size) = (rank.map_err(|error| error.to_string())?, size.map_err(|error| error.to_string())?);
        let listener = meeting.listener.map_or(-1, IntoRawFd::into_raw_fd);
        let mut size_of_first = size;
        let mut reason = Reason::default();
        // SAFETY: the texts end with 0 and live until the function returns. c10d owns the socket from now on. Every C++ exception is
        // caught.
        let group = unsafe {
            comic_world_meet(
                host.as_ptr(),
                meeting.address.port(),
                listener,
                own.as_ptr(),
                rank,
                size,
                milliseconds(meeting.patience),
                &raw mut size_of_first,
                reason.room(),
                REASON,
            )
        };
        NonNull::new(group).map(|group| Self { group, operations: 0 }).ok_or_else(|| match size_of_first == size {
            true => NotMet::Failed(reason.text()),
            false => NotMet::OtherSize(size_of_first),
        })
    }

    /// From now on an operation waits so long for the other ranks.
    pub(super) fn wait_for(&mut self, patience: Duration) {
        // SAFETY: the group lives. The function only stores a number.
        unsafe { comic_world_wait_for(self.group.as_ptr(), milliseconds(patience)) }
    }

    /// How many operations there were.
    pub(super) fn operations(&self) -> u64 {
        self.operations
    }

    /// Counts an operation with these tensors. gloo goes through memory in order.
    fn begin(&mut self, tensors: &[&Tensor]) -> Result<(), String> {
        self.operations += 1;
        match tensors.iter().find(|tensor| !tensor.is_contiguous() || tensor.device() != Device::Cpu) {
            Some(tensor) => Err(format!("{tensor:?} is not contiguous on the CPU")),
            None => Ok(()),
        }
    }

    /// The sum over all ranks, in place.
    ///
    /// # Errors
    /// What c10d says.
    pub(super) fn sum(&mut self, tensor: &Tensor) -> Result<(), String> {
        self.begin(&[tensor])?;
        let mut reason = Reason::default();
        // SAFETY: the group lives, and the tensor is one of the CPU that lives until the function returns. Every C++ exception is caught.
        let done = unsafe { comic_world_sum(self.group.as_ptr(), pointer(tensor), reason.room(), REASON) };
        reason.unless(done)
    }

    /// The tensors of all ranks into `all`, which has as many times the elements of `tensor` as there are ranks.
    ///
    /// # Errors
    /// What c10d says.
    pub(super) fn gather(&mut self, tensor: &Tensor, all: &Tensor) -> Result<(), String> {
        self.begin(&[tensor, all])?;
        let mut reason = Reason::default();
        // SAFETY: as in `sum`. c10d checks the sizes.
        let done =
            unsafe { comic_world_gather(self.group.as_ptr(), pointer(tensor), pointer(all), reason.room(), REASON) };
        reason.unless(done)
    }

    /// The tensor of rank 0 into that of all others.
    ///
    /// # Errors
    /// What c10d says.
    pub(super) fn broadcast(&mut self, tensor: &Tensor) -> Result<(), String> {
        self.begin(&[tensor])?;
        let mut reason = Reason::default();
        // SAFETY: as in `sum`.
        let done = unsafe { comic_world_broadcast(self.group.as_ptr(), pointer(tensor), reason.room(), REASON) };
        reason.unless(done)
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        // SAFETY: the group is the one that was made, and is not used any more.
        unsafe { comic_world_leave(self.group.as_ptr()) }
    }
}

/// Bytes for what c10d says.
const REASON: usize = 512;

/// What c10d says when it fails.
struct Reason([u8; REASON]);

impl Default for Reason {
    fn default() -> Self {
        Self([0; REASON])
    }
}

impl Reason {
    fn room(&mut self) -> *mut c_char {
        self.0.as_mut_ptr().cast()
    }

    /// The first line of it: a trace of C++ functions may follow.
    fn text(&self) -> String {
        let text = String::from_utf8_lossy(&self.0);
        text.trim_end_matches('\0').lines().next().unwrap_or_default().to_owned()
    }

    fn unless(&self, done: bool) -> Result<(), String> {
        if done { Ok(()) } else { Err(self.text()) }
    }
}

fn milliseconds(duration: Duration) -> i64 {
    i64::try_from(duration.as_millis()).unwrap_or(i64::MAX)
}

fn pointer(tensor: &Tensor) -> *const c_void {
    tensor.as_ptr().cast()
}
