//! XML-RPC values, as CPython's `xmlrpc` package understands them.

use std::{
    ops::{Deref, DerefMut},
    sync::Arc,
};

use indexmap::IndexMap;

/// The members of a [`Struct`].
type Members = IndexMap<String, Value>;

/// An XML-RPC struct. It keeps the order of its keys, like a Python dict.
///
/// A clone shares its members until one of the two is changed. Only then are these members copied; structs inside them
/// stay shared. So copying a large parameter tree is free. Changing it while a copy exists costs as much as copying the
/// members of the namespaces on the path to the change.
#[derive(Clone, Debug, Default)]
pub struct Struct(Arc<Members>);

impl Struct {
    /// A struct without members.
    pub fn new() -> Self {
        Self::default()
    }

    /// An empty struct with room for `count` members.
    pub fn with_capacity(count: usize) -> Self {
        Self(Arc::new(Members::with_capacity(count)))
    }
}

impl Deref for Struct {
    type Target = Members;

    fn deref(&self) -> &Members {
        &self.0
    }
}

impl DerefMut for Struct {
    fn deref_mut(&mut self) -> &mut Members {
        Arc::make_mut(&mut self.0)
    }
}

/// Compares members and their order.
impl PartialEq for Struct {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0) || self.iter().eq(other.iter())
    }
}

impl Eq for Struct {}

impl FromIterator<(String, Value)> for Struct {
    fn from_iter<I: IntoIterator<Item = (String, Value)>>(members: I) -> Self {
        Self(Arc::new(members.into_iter().collect()))
    }
}

/// A short form for tests and examples.
impl From<&[(&str, Value)]> for Struct {
    fn from(members: &[(&str, Value)]) -> Self {
        let members = members.iter().cloned();
        members
            .map(|(key, value)| (key.to_owned(), value))
            .collect()
    }
}

impl<const N: usize> From<[(String, Value); N]> for Struct {
    fn from(members: [(String, Value); N]) -> Self {
        members.into_iter().collect()
    }
}

impl IntoIterator for Struct {
    type Item = (String, Value);
    type IntoIter = indexmap::map::IntoIter<String, Value>;

    fn into_iter(self) -> Self::IntoIter {
        Arc::unwrap_or_clone(self.0).into_iter()
    }
}

impl<'a> IntoIterator for &'a Struct {
    type Item = (&'a String, &'a Value);
    type IntoIter = indexmap::map::Iter<'a, String, Value>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.iter()
    }
}

/// An XML-RPC value.
///
/// Two values are equal if they look the same on the wire. Doubles need the same bits, so `nan` equals `nan`, and
/// `-0.0` differs from `0.0`. `1`, `1.0` and `true` all differ. Structs must have their keys in the same order, because
/// replies show it.
#[derive(Clone, Debug)]
pub enum Value {
    /// `<nil/>`. rosmaster accepts it inside values but can never return it.
    Nil,
    /// `<boolean>`.
    Bool(bool),
    /// `<int>` or `<i4>`: an integer that fits into 32 bits.
    Int(i32),
    /// An integer beyond 32 bits, in canonical decimal form. rosmaster accepts it but can never return it.
    BigInt(String),
    /// `<bigdecimal>`: the text of a decimal number. rosmaster on Python 3 accepts it but can never return it.
    BigDecimal(String),
    /// `<double>`.
    Double(f64),
    /// `<string>`, or text without a type element.
    String(String),
    /// `<dateTime.iso8601>`: the text, which CPython does not parse.
    DateTime(String),
    /// `<base64>`, decoded.
    Base64(Vec<u8>),
    /// `<array>`.
    Array(Vec<Self>),
    /// `<struct>`.
    Struct(Struct),
}

impl PartialEq for Value {
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Nil, Self::Nil) => true,
            (Self::Bool(a), Self::Bool(b)) => a == b,
            (Self::Int(a), Self::Int(b)) => a == b,
            (Self::Double(a), Self::Double(b)) => a.to_bits() == b.to_bits(),
            (Self::BigInt(a), Self::BigInt(b))
            | (Self::BigDecimal(a), Self::BigDecimal(b))
            | (Self::String(a), Self::String(b))
            | (Self::DateTime(a), Self::DateTime(b)) => a == b,
            (Self::Base64(a), Self::Base64(b)) => a == b,
            (Self::Array(a), Self::Array(b)) => a == b,
            (Self::Struct(a), Self::Struct(b)) => a == b,
            _ => false,
        }
    }
}

impl Eq for Value {}

impl Value {
    /// Whether two values are equal apart from the order of struct members. Arrays must have the same order.
    pub fn equals_in_any_order(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Struct(a), Self::Struct(b)) => {
                let in_b = |(key, a): (&String, &Self)| {
                    b.get(key).is_some_and(|b| a.equals_in_any_order(b))
                };
                a.len() == b.len() && a.iter().all(in_b)
            }
            (Self::Array(a), Self::Array(b)) => {
                a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.equals_in_any_order(b))
            }
            _ => self == other,
        }
    }

    /// Approximate memory use, in bytes.
    pub fn size(&self) -> usize {
        let mut size = 0;
        self.visit_sizes(&mut |part| {
            size += part;
            true
        });
        size
    }

    /// Whether this value uses more than about `bytes` of memory. Stops counting at this limit.
    pub fn is_larger_than(&self, mut bytes: usize) -> bool {
        !self.visit_sizes(&mut |part| {
            let rest = bytes.checked_sub(part);
            bytes = rest.unwrap_or_default();
            rest.is_some()
        })
    }

    /// Passes the size of each part to `visit` until `visit` returns false. Returns whether it returned true for all
    /// parts.
    fn visit_sizes(&self, visit: &mut impl FnMut(usize) -> bool) -> bool {
        let within = match self {
            Self::BigInt(text)
            | Self::BigDecimal(text)
            | Self::String(text)
            | Self::DateTime(text) => text.len(),
            Self::Base64(bytes) => bytes.len(),
            _ => 0,
        };
        visit(size_of::<Self>() + within)
            && match self {
                Self::Array(elements) => elements.iter().all(|element| element.visit_sizes(visit)),
                Self::Struct(members) => members.iter().all(|(key, value)| {
                    visit(size_of::<String>() + key.len()) && value.visit_sizes(visit)
                }),
                _ => true,
            }
    }

    pub fn as_str(&self) -> Option<&str> {
        match self {
            Self::String(text) => Some(text),
            _ => None,
        }
    }

    /// Name of the Python type to which CPython decodes this value.
    pub(crate) fn python_type(&self) -> &'static str {
        match self {
            Self::Nil => "NoneType",
            Self::Bool(_) => "bool",
            Self::Int(_) | Self::BigInt(_) => "int",
            Self::BigDecimal(_) => "decimal.Decimal",
            Self::Double(_) => "float",
            Self::String(_) => "str",
            Self::DateTime(_) => "DateTime",
            Self::Base64(_) => "Binary",
            Self::Array(_) => "list",
            Self::Struct(_) => "dict",
        }
    }

    pub fn as_int(&self) -> Option<i32> {
        match self {
            Self::Int(number) => Some(*number),
            _ => None,
        }
    }

    pub fn as_array(&self) -> Option<&[Self]> {
        match self {
            Self::Array(elements) => Some(elements),
            _ => None,
        }
    }

    pub fn as_struct(&self) -> Option<&Struct> {
        match self {
            Self::Struct(members) => Some(members),
            _ => None,
        }
    }
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::String(text.to_owned())
    }
}

impl From<String> for Value {
    fn from(text: String) -> Self {
        Self::String(text)
    }
}

impl From<i32> for Value {
    fn from(number: i32) -> Self {
        Self::Int(number)
    }
}

impl From<bool> for Value {
    fn from(truth: bool) -> Self {
        Self::Bool(truth)
    }
}

impl From<f64> for Value {
    fn from(number: f64) -> Self {
        Self::Double(number)
    }
}

impl<T: Into<Self>> From<Vec<T>> for Value {
    fn from(elements: Vec<T>) -> Self {
        Self::Array(elements.into_iter().map(Into::into).collect())
    }
}

/// An XML-RPC call: a method name and parameters.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Call {
    /// The method's name, such as `registerPublisher`.
    pub method: String,
    /// The parameters in order. In the Master API the first one is the caller id.
    pub params: Vec<Value>,
}

impl Call {
    /// Creates a call of `method` with `params`.
    pub fn new(method: impl Into<String>, params: Vec<Value>) -> Self {
        Self {
            method: method.into(),
            params,
        }
    }

    /// Creates a `system.multicall` of `calls`, in order.
    pub fn multicall(calls: impl IntoIterator<Item = Self>) -> Self {
        let entries = calls.into_iter().map(Self::into_entry);
        Self::new("system.multicall", vec![Value::Array(entries.collect())])
    }

    /// Converts this call to an entry of a multicall.
    pub fn into_entry(self) -> Value {
        Value::Struct(Struct::from([
            ("methodName".to_owned(), Value::String(self.method)),
            ("params".to_owned(), Value::Array(self.params)),
        ]))
    }
}

/// The answer to an XML-RPC call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Reply {
    /// The method's result.
    Value(Value),
    /// An error of the method or the server.
    Fault {
        /// Always 1 from CPython's server.
        code: i32,
        /// `<class 'NAME'>:TEXT` from CPython's server.
        text: String,
    },
}
