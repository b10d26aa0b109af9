//! Copies that bypass the processor's caches.
//!
//! A batch has tens of megabytes that are not read before it is full. An ordinary store first loads its cache line from
//! memory, and evicts another line that may still be needed. A non-temporal store does neither.
//! `cargo xtask bench ingest` measures the difference.

#![allow(unsafe_code, reason = "two instructions are only available as unsafe functions")]

/// Copies `from` to `into`, which should not be read soon.
///
/// # Panics
/// If the lengths differ.
pub(crate) fn copy(from: &[u8], into: &mut [u8]) {
    #[cfg(target_arch = "x86_64")]
    x86_64::copy(from, into);
    #[cfg(not(target_arch = "x86_64"))]
    into.copy_from_slice(from);
}

#[cfg(target_arch = "x86_64")]
mod x86_64 {
    use std::arch::x86_64::{__m128i, _mm_sfence, _mm_stream_si128};

    /// Least length of a non-temporal copy, bytes. For shorter copies the fence costs more than the caches.
    const WORTHWHILE: usize = 4096;
    const WIDTH: usize = size_of::<__m128i>();

    pub(super) fn copy(from: &[u8], into: &mut [u8]) {
        assert_eq!(from.len(), into.len(), "the lengths of a copy differ");
        if from.len() < WORTHWHILE {
            return into.copy_from_slice(from);
        }
        let (head, body, tail) = bytemuck::pod_align_to_mut::<u8, __m128i>(into);
        let (first, rest) = from.split_at(head.len());
        let (middle, last) = rest.split_at(body.len() * WIDTH);
        head.copy_from_slice(first);
        for (from, into) in middle.chunks_exact(WIDTH).zip(body) {
            // SAFETY: `into` is a mutable reference, so the memory is aligned and exclusive, as the instruction
            // requires. Every x86_64 processor has SSE2. The store is not ordered with other stores, but the fence
            // below comes before any other code can read the memory.
            unsafe { _mm_stream_si128(into, bytemuck::pod_read_unaligned(from)) };
        }
        tail.copy_from_slice(last);
        // SAFETY: every x86_64 processor has SSE.
        unsafe { _mm_sfence() };
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    proptest! {
        /// For all offsets and lengths, the copy is complete, and the bytes around it do not change.
        #[test]
        fn a_copy_equals_its_source(
            length in prop_oneof![0_usize..200, 4000_usize..4300, 10_000_usize..40_000],
            from in 0_usize..70, into in 0_usize..70, seed in any::<u8>(),
        ) {
            let source: Vec<u8> = (0..from + length).map(|at| (at as u8).wrapping_mul(31) ^ (at >> 8) as u8 ^ seed).collect();
            let mut target = vec![0xa5; into + length + 70];
            super::copy(&source[from..], &mut target[into..into + length]);
            prop_assert_eq!(&target[into..into + length], &source[from..]);
            prop_assert!(target[..into].iter().chain(&target[into + length..]).all(|byte| *byte == 0xa5));
        }
    }
}
