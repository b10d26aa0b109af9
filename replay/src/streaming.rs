//! Copies that leave the processor's caches alone.
//!
//! A batch is tens of megabytes that nobody reads before it is full. An ordinary store first fetches the line that it writes
//! to from memory, and takes the place of something that is still needed; a non-temporal one does neither.
//! `cargo xtask bench ingest` shows what that is worth.

#![allow(unsafe_code, reason = "two instructions that Rust has as unsafe functions alone")]

/// Copies `from` over `into`, which nobody is about to read.
///
/// # Panics
/// When the two are not of one length.
pub(crate) fn copy(from: &[u8], into: &mut [u8]) {
    #[cfg(target_arch = "x86_64")]
    x86_64::copy(from, into);
    #[cfg(not(target_arch = "x86_64"))]
    into.copy_from_slice(from);
}

#[cfg(target_arch = "x86_64")]
mod x86_64 {
    use std::arch::x86_64::{__m128i, _mm_sfence, _mm_stream_si128};

    /// Of fewer bytes the caches make less ado than the fence.
    const WORTHWHILE: usize = 4096;
    const WIDTH: usize = size_of::<__m128i>();

    pub(super) fn copy(from: &[u8], into: &mut [u8]) {
        assert_eq!(from.len(), into.len(), "a copy is as long as what it is of");
        if from.len() < WORTHWHILE {
            return into.copy_from_slice(from);
        }
        let (head, body, tail) = bytemuck::pod_align_to_mut::<u8, __m128i>(into);
        let (first, rest) = from.split_at(head.len());
        let (middle, last) = rest.split_at(body.len() * WIDTH);
        head.copy_from_slice(first);
        for (from, into) in middle.chunks_exact(WIDTH).zip(body) {
            // SAFETY: a reference leads to memory of this type that is aligned and nobody else's, as the instruction wants
            // it, and SSE2, of which it is, belongs to every processor of x86_64. It is not ordered with other stores:
            // nothing is read or handed on before the fence.
            unsafe { _mm_stream_si128(into, bytemuck::pod_read_unaligned(from)) };
        }
        tail.copy_from_slice(last);
        // SAFETY: SSE, too, belongs to every processor of x86_64.
        unsafe { _mm_sfence() };
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    proptest! {
        /// Wherever either begins and however long they are, every byte of the place is the copy's, and none beside it.
        #[test]
        fn a_copy_is_what_it_is_of(
            length in prop_oneof![0_usize..200, 4000_usize..4300, 10_000_usize..40_000],
            from in 0_usize..70, into in 0_usize..70, seed in any::<u8>(),
        ) {
            let source: Vec<u8> = (0..from + length).map(|at| (at as u8).wrapping_mul(31) ^ (at >> 8) as u8 ^ seed).collect();
            let mut place = vec![0xa5; into + length + 70];
            super::copy(&source[from..], &mut place[into..into + length]);
            prop_assert_eq!(&place[into..into + length], &source[from..]);
            prop_assert!(place[..into].iter().chain(&place[into + length..]).all(|byte| *byte == 0xa5));
        }
    }
}
