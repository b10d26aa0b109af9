//! One value for each field of an unroll.

use std::ops::{Index, IndexMut};

use crate::layout::Field;

/// A value for every [`Field`], indexed by it. Code that keeps something for each field does not list the fields.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FieldMap<T>(Vec<T>);

impl<T> FieldMap<T> {
    /// The value that `make` gives for each field, in payload order.
    pub fn from_fn(make: impl FnMut(Field) -> T) -> Self {
        Self(Field::ALL.into_iter().map(make).collect())
    }

    /// As [`from_fn`](Self::from_fn), up to the first error.
    ///
    /// # Errors
    /// The first one that `make` gives.
    pub fn try_from_fn<E>(make: impl FnMut(Field) -> Result<T, E>) -> Result<Self, E> {
        Ok(Self(Field::ALL.into_iter().map(make).collect::<Result<_, E>>()?))
    }

    /// The result of `change` for each field's value.
    pub fn map<'a, U>(&'a self, change: impl FnMut(&'a T) -> U) -> FieldMap<U> {
        FieldMap(self.0.iter().map(change).collect())
    }
}

impl<T> Index<Field> for FieldMap<T> {
    type Output = T;

    fn index(&self, field: Field) -> &T {
        &self.0[field as usize]
    }
}

impl<T> IndexMut<Field> for FieldMap<T> {
    fn index_mut(&mut self, field: Field) -> &mut T {
        &mut self.0[field as usize]
    }
}
