//! Host side tests.
