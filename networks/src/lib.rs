//! comic-networks
