//! numpy arrays as slices of fixed-size rows, and back. Errors begin with the argument's name.

use numpy::{
    Element, IntoPyArray, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Borrows an argument as an array of `T`. ValueError if it is another object or not C-contiguous.
pub fn array<'py, T: Element>(
    name: &str,
    object: &Bound<'py, PyAny>,
) -> PyResult<PyReadonlyArrayDyn<'py, T>> {
    let wanted = numpy::dtype::<T>(object.py());
    let Ok(typed) = object.cast::<PyArrayDyn<T>>() else {
        let found = match object.cast::<numpy::PyUntypedArray>() {
            Ok(other) => format!("{} array", other.dtype().typeobj().name()?),
            Err(_) => object.get_type().name()?.to_string(),
        };
        return Err(PyValueError::new_err(format!(
            "{name}: must be a numpy array of {}, not a {found}",
            wanted.typeobj().name()?
        )));
    };
    if !typed.is_c_contiguous() {
        return Err(PyValueError::new_err(format!("{name}: must be C-contiguous")));
    }
    typed.try_readonly().map_err(|error| PyValueError::new_err(format!("{name}: {error}")))
}

/// Borrows the entry `name` of a dict, as [`array`] does.
pub fn entry<'py, T: Element>(
    dict: &Bound<'py, PyDict>,
    name: &str,
) -> PyResult<PyReadonlyArrayDyn<'py, T>> {
    match dict.get_item(name)? {
        Some(object) => array(name, &object),
        None => Err(PyValueError::new_err(format!("{name}: is missing"))),
    }
}

/// All elements of an array of shape `shape`; -1 matches any size.
pub fn elements<'a, T: Element>(
    name: &str,
    array: &'a PyReadonlyArrayDyn<'_, T>,
    shape: &[isize],
) -> PyResult<&'a [T]> {
    let found = array.shape();
    let fits = found.len() == shape.len()
        && found.iter().zip(shape).all(|(&f, &s)| s < 0 || usize::try_from(s) == Ok(f));
    if !fits {
        let wanted: Vec<String> =
            shape.iter().map(|&s| if s < 0 { "*".to_owned() } else { s.to_string() }).collect();
        return Err(PyValueError::new_err(format!(
            "{name}: must have shape [{}], not {found:?}",
            wanted.join(", ")
        )));
    }
    array.as_slice().map_err(|error| PyValueError::new_err(format!("{name}: {error}")))
}

/// The rows of an array of shape `leading` + `[N]`; -1 matches any size.
pub fn rows<'a, T: Element, const N: usize>(
    name: &str,
    array: &'a PyReadonlyArrayDyn<'_, T>,
    leading: &[isize],
) -> PyResult<&'a [[T; N]]> {
    let mut shape = leading.to_vec();
    shape.push(N as isize);
    Ok(elements(name, array, &shape)?.as_chunks::<N>().0)
}

/// The values of an array of shape `[N]`.
pub fn row<T: Element + Copy, const N: usize>(
    name: &str,
    object: &Bound<'_, PyAny>,
) -> PyResult<[T; N]> {
    let array = array::<T>(name, object)?;
    Ok(rows::<T, N>(name, &array, &[])?[0])
}

/// Turns a vector into an array of the given shape, without a copy.
pub fn shaped<'py, T: Element>(
    py: Python<'py>,
    values: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    values.into_pyarray(py).reshape(shape)
}

/// Turns rows into an array of shape `leading` + `[N]`, without a copy.
pub fn shaped_rows<'py, T: Element, const N: usize>(
    py: Python<'py>,
    values: Vec<[T; N]>,
    leading: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let mut shape = leading.to_vec();
    shape.push(N);
    shaped(py, values.into_flattened(), &shape)
}
