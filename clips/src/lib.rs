//! comic-clips
