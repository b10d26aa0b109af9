//! One value for each field of an unroll.

use std::array;
use std::ops::{Index, IndexMut};

use crate::field::Field;

/// An array with one value for each [`Field`], indexed by the field.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PerField<T>([T; Field::ALL.len()]);

impl<T> PerField<T> {
    /// The value of each field, made in payload order.
    pub fn from_fn(mut make: impl FnMut(Field) -> T) -> Self {
        Self(array::from_fn(|index| make(Field::ALL[index])))
    }

    /// References to the values.
    pub fn each_ref(&self) -> PerField<&T> {
        PerField(self.0.each_ref())
    }

    /// Mutable references to the values.
    pub fn each_mut(&mut self) -> PerField<&mut T> {
        PerField(self.0.each_mut())
    }

    /// Another value for each field, made in payload order.
    pub fn map<U>(self, mut change: impl FnMut(Field, T) -> U) -> PerField<U> {
        let mut fields = Field::ALL.into_iter();
        PerField(self.0.map(|value| change(fields.next().unwrap_or(Field::Image), value)))
    }

    /// Fields and values in payload order.
    pub fn iter(&self) -> impl Iterator<Item = (Field, &T)> {
        Field::ALL.into_iter().zip(&self.0)
    }

    /// Fields and values in payload order.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (Field, &mut T)> {
        Field::ALL.into_iter().zip(&mut self.0)
    }
}

impl<T> Index<Field> for PerField<T> {
    type Output = T;

    fn index(&self, field: Field) -> &T {
        &self.0[field as usize]
    }
}

impl<T> IndexMut<Field> for PerField<T> {
    fn index_mut(&mut self, field: Field) -> &mut T {
        &mut self.0[field as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_value_is_found_by_its_field() {
        let names = PerField::from_fn(Field::name);
        let lengths = names.map(|field, name| (field, name.len()));
        for field in Field::ALL {
            assert_eq!(names[field], field.name());
            assert_eq!(lengths[field], (field, field.name().len()));
        }
        assert!(names.iter().all(|(field, name)| field.name() == *name));
    }
}
