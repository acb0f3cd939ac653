//! Arguments of a Python call by name, for functions with more of them than one signature should list.

use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

/// Arguments of one call that have not been taken yet.
pub struct Call<'py> {
    function: &'static str,
    rest: Bound<'py, PyDict>,
}

impl<'py> Call<'py> {
    /// Binds positional arguments to `names`, in order, and adds the keyword arguments.
    ///
    /// TypeError if there are more positional arguments than names, or one was given twice.
    pub fn bind(
        function: &'static str,
        names: &[&str],
        positional: &Bound<'py, PyTuple>,
        named: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Self> {
        let wrong = |what: String| PyTypeError::new_err(format!("{function}() {what}"));
        let rest = match named {
            Some(named) => named.copy()?,
            None => PyDict::new(positional.py()),
        };
        if positional.len() > names.len() {
            return Err(wrong(format!(
                "takes {} positional arguments, not {}",
                names.len(),
                positional.len()
            )));
        }
        for (name, value) in names.iter().zip(positional) {
            if rest.contains(name)? {
                return Err(wrong(format!("got multiple values for argument '{name}'")));
            }
            rest.set_item(name, value)?;
        }
        Ok(Self { function, rest })
    }

    /// An argument that must be there, as it is. TypeError if it is missing.
    pub fn object(&self, name: &str) -> PyResult<Bound<'py, PyAny>> {
        let Some(value) = self.rest.get_item(name)? else {
            return Err(PyTypeError::new_err(format!(
                "{}() missing required argument: '{name}'",
                self.function
            )));
        };
        self.rest.del_item(name)?;
        Ok(value)
    }

    /// A dict that must be there. TypeError if it is missing, ValueError if it is none.
    pub fn dict(&self, name: &str) -> PyResult<Bound<'py, PyDict>> {
        let object = self.object(name)?;
        let wrong = |_| PyValueError::new_err(format!("{name}: must be a dict"));
        object.cast_into::<PyDict>().map_err(wrong)
    }

    /// An argument that must be there. TypeError if it is missing, ValueError if it is no `T`.
    pub fn take<T>(&self, name: &str) -> PyResult<T>
    where
        T: for<'a> FromPyObject<'a, 'py>,
    {
        converted(name, &self.object(name)?)
    }

    /// An argument that may be missing or None.
    pub fn optional<T>(&self, name: &str) -> PyResult<Option<T>>
    where
        T: for<'a> FromPyObject<'a, 'py>,
    {
        if self.rest.contains(name)? { self.take(name) } else { Ok(None) }
    }

    /// TypeError if an unknown argument is left.
    pub fn finish(self) -> PyResult<()> {
        match self.rest.keys().iter().next() {
            None => Ok(()),
            Some(name) => Err(PyTypeError::new_err(format!(
                "{}() got an unexpected keyword argument '{name}'",
                self.function
            ))),
        }
    }
}

/// The entry `name` of a dict of settings, None if it is absent or None.
pub fn setting<'py, T>(settings: &Bound<'py, PyDict>, name: &str) -> PyResult<Option<T>>
where
    T: for<'a> FromPyObject<'a, 'py>,
{
    settings.get_item(name)?.map_or(Ok(None), |value| converted(name, &value))
}

/// A setting that is one of a few words, None if it is absent or None.
pub fn choice<T: Copy>(
    settings: &Bound<'_, PyDict>,
    name: &str,
    choices: &[(&str, T)],
) -> PyResult<Option<T>> {
    let Some(word) = setting::<String>(settings, name)? else { return Ok(None) };
    let found = choices.iter().find(|(known, _)| *known == word);
    found.map(|(_, value)| Some(*value)).ok_or_else(|| {
        let known: Vec<&str> = choices.iter().map(|(known, _)| *known).collect();
        let (last, others) = known.split_last().unwrap_or((&"", &[]));
        PyValueError::new_err(format!(
            "{name}: must be {} or {last}, not {word:?}",
            others.join(", ")
        ))
    })
}

fn converted<'py, T>(name: &str, value: &Bound<'py, PyAny>) -> PyResult<T>
where
    T: for<'a> FromPyObject<'a, 'py>,
{
    match value.extract() {
        Ok(value) => Ok(value),
        Err(_) => Err(PyValueError::new_err(format!("{name}: cannot be {}", value.repr()?))),
    }
}
