//! Versions of Python. They differ in the XML-RPC that they accept, and in the words of their faults.

/// The version of Python on which a master runs.
///
/// ```
/// use ros1_master::xmlrpc::Python;
///
/// assert_eq!(Python::of_server("BaseHTTP/0.3 Python/2.7.18"), Some(Python::new(2, 7, 18)));
/// assert!(!Python::new(2, 7, 18).keeps_order());
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Python {
    major: u32,
    minor: u32,
    micro: u32,
}

/// The version that this crate follows where nothing else is said: that of Debian 12.
impl Default for Python {
    fn default() -> Self {
        Self::new(3, 11, 2)
    }
}

impl Python {
    /// For example 3, 11 and 2.
    pub const fn new(major: u32, minor: u32, micro: u32) -> Self {
        Self {
            major,
            minor,
            micro,
        }
    }

    /// The version in a `Server` header such as `BaseHTTP/0.6 Python/3.11.2`.
    pub fn of_server(header: &str) -> Option<Self> {
        let mut words = header.split_whitespace();
        let version = words.find_map(|word| word.strip_prefix("Python/"))?;
        let mut parts = version.split('.');
        let (major, minor) = (parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
        // A version between two releases is `2.7.15+` or `2.7.15rc1`.
        let micro = parts.next().unwrap_or_default();
        let digits = micro.split(|c: char| !c.is_ascii_digit()).next();
        let micro = digits.and_then(|digits| digits.parse().ok());
        Some(Self::new(major, minor, micro.unwrap_or_default()))
    }

    /// Whether dictionaries keep the order of their keys.
    pub fn keeps_order(self) -> bool {
        self >= Self::new(3, 6, 0)
    }

    /// Whether this is Python 2, whose `xmlrpclib` knows fewer types.
    pub fn is_two(self) -> bool {
        self.major == 2
    }

    /// Whether elements of unknown types are ignored instead of refused.
    pub(super) fn ignores_unknown_types(self) -> bool {
        self.is_two() && self < Self::new(2, 7, 12)
    }

    /// Whether numbers may contain underscores.
    pub(super) fn has_underscores(self) -> bool {
        self.keeps_order()
    }

    /// The text of a fault in this Python's form. `fault` has the form of Python 3: `<class 'NAME'>:TEXT`.
    pub(crate) fn fault(self, fault: String) -> String {
        let builtin = fault.strip_prefix("<class '").filter(|_| self.is_two());
        match builtin.and_then(|rest| rest.split_once("'>:")) {
            Some((class, text)) if !class.contains('.') => {
                format!("<type 'exceptions.{class}'>:{text}")
            }
            Some(("xmlrpc.client.ResponseError", text)) => {
                format!("<class 'xmlrpclib.ResponseError'>:{text}")
            }
            _ => fault,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_version_is_in_the_server_header() {
        for (header, version) in [
            ("BaseHTTP/0.3 Python/2.7.18", Some((2, 7, 18))),
            ("BaseHTTP/0.3 Python/2.7.11+", Some((2, 7, 11))),
            ("BaseHTTP/0.3 Python/2.7.15rc1", Some((2, 7, 15))),
            ("BaseHTTP/0.6 Python/3.13.5", Some((3, 13, 5))),
            ("Python/3.6", Some((3, 6, 0))),
            ("BaseHTTP/0.6 Python/3", None),
            ("BaseHTTP/0.6 Python/x.y", None),
            ("XMLRPC++ 0.7", None),
            ("", None),
        ] {
            let version = version.map(|(major, minor, micro)| Python::new(major, minor, micro));
            assert_eq!(Python::of_server(header), version, "{header}");
        }
    }

    #[test]
    fn python_2_names_exceptions_differently() {
        let two = |text: &str| Python::new(2, 7, 18).fault(text.to_owned());
        assert_eq!(
            two("<class 'KeyError'>:'a'"),
            "<type 'exceptions.KeyError'>:'a'"
        );
        let response = two("<class 'xmlrpc.client.ResponseError'>:ResponseError()");
        assert_eq!(
            response,
            "<class 'xmlrpclib.ResponseError'>:ResponseError()"
        );
        for same in ["<class 'binascii.Error'>:Incorrect padding", "malformed"] {
            assert_eq!(two(same), same);
        }
        let three = "<class 'KeyError'>:'a'";
        assert_eq!(Python::default().fault(three.to_owned()), three);
    }
}
