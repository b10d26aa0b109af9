//! Places that peers take: so many in all, and so many for one address.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::Arc;

use parking_lot::Mutex;

/// A limit on what all peers and what the peers of one address take at once.
#[derive(Debug)]
pub(crate) struct Places {
    total: usize,
    per_address: usize,
    taken: Mutex<Taken>,
}

/// Numbers of taken places.
#[derive(Debug, Default)]
struct Taken {
    by_address: HashMap<IpAddr, usize>,
    total: usize,
}

/// Which limit is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Full {
    /// That of all peers.
    Total,
    /// That of the address.
    Address,
}

impl Places {
    pub(crate) fn new(total: usize, per_address: usize) -> Arc<Self> {
        Arc::new(Self { total, per_address, taken: Mutex::default() })
    }

    /// A place for a peer of this address.
    pub(crate) fn take(self: &Arc<Self>, address: IpAddr) -> Result<Place, Full> {
        let address = network(address);
        let mut taken = self.taken.lock();
        if taken.total >= self.total {
            return Err(Full::Total);
        }
        let of_address = taken.by_address.entry(address).or_default();
        if *of_address >= self.per_address {
            return Err(Full::Address);
        }
        *of_address += 1;
        taken.total += 1;
        Ok(Place { places: self.clone(), address })
    }
}

/// What counts as one address. A host with IPv6 has a whole network of 64 bits (RFC 4291, 2.5.4).
pub(crate) fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() >> 64 << 64).into(),
        address => address,
    }
}

/// A place. Its drop frees it.
#[derive(Debug)]
pub(crate) struct Place {
    places: Arc<Places>,
    address: IpAddr,
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.taken.lock();
        taken.total -= 1;
        if let Some(of_address) = taken.by_address.get_mut(&self.address) {
            *of_address -= 1;
            if *of_address == 0 {
                taken.by_address.remove(&self.address);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    #[test]
    fn one_address_takes_at_most_its_number() {
        let places = Places::new(10, 2);
        let taken = [(); 2].map(|()| places.take(address("192.0.2.1")).unwrap());
        assert_eq!(places.take(address("192.0.2.1")).unwrap_err(), Full::Address);
        assert_eq!(places.take(address("::ffff:192.0.2.1")).unwrap_err(), Full::Address, "the same address");
        let other = places.take(address("192.0.2.2")).unwrap();
        drop(taken);
        drop(places.take(address("192.0.2.1")).unwrap());
        drop(other);
        assert!(places.taken.lock().by_address.is_empty() && places.taken.lock().total == 0);
    }

    #[test]
    fn all_addresses_together_take_at_most_the_total() {
        let places = Places::new(4, 2);
        let taken: Vec<_> = (0..4).map(|last| places.take(IpAddr::from([192, 0, 2, last])).unwrap()).collect();
        assert_eq!(places.take(address("192.0.2.9")).unwrap_err(), Full::Total);
        drop(taken);
        assert!(places.take(address("192.0.2.9")).is_ok());
    }

    #[test]
    fn the_addresses_of_one_ipv6_network_are_one() {
        let places = Places::new(10, 1);
        let _taken = places.take(address("2001:db8:1:2::1")).unwrap();
        assert_eq!(places.take(address("2001:db8:1:2:ffff::2")).unwrap_err(), Full::Address);
        assert!(places.take(address("2001:db8:1:3::1")).is_ok());
    }
}
