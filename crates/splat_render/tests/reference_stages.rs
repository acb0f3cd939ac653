//! The checks that do not compare with the reference, run on the reference itself.

#[macro_use]
mod common;

use common::narrowed::Narrowed;

checks_of_all! { [&Narrowed]; 300, 24 }

checks! {
    [&Narrowed];
    hard_cases::thresholds_are_the_same_everywhere();
}
