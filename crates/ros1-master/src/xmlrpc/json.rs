//! Serializes XML-RPC values as JSON for other programs.

use base64::Engine as _;
use serde::{Serialize, Serializer};

use super::{Struct, Value};

/// Serializes a value. Dates, binary data (as base64), integers beyond 32 bits, decimal numbers, infinities and NaN
/// become strings, because JSON lacks them.
impl Serialize for Value {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Nil => to.serialize_unit(),
            Self::Bool(truth) => to.serialize_bool(*truth),
            Self::Int(number) => to.serialize_i32(*number),
            Self::Double(number) if !number.is_finite() => to.collect_str(number),
            Self::Double(number) => to.serialize_f64(*number),
            Self::BigInt(text)
            | Self::BigDecimal(text)
            | Self::String(text)
            | Self::DateTime(text) => to.serialize_str(text),
            Self::Base64(bytes) => {
                to.serialize_str(&base64::engine::general_purpose::STANDARD.encode(bytes))
            }
            Self::Array(elements) => to.collect_seq(elements),
            Self::Struct(members) => members.serialize(to),
        }
    }
}

impl Serialize for Struct {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.collect_map(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_can_be_written_as_json() {
        let values = Value::Array(vec![
            Value::Nil,
            true.into(),
            (-3).into(),
            2.0.into(),
            f64::NAN.into(),
            Value::BigInt("12345678901".to_owned()),
            "a\"b".into(),
            Value::DateTime("20260102T03:04:05".to_owned()),
            Value::Base64(vec![0, 255]),
            Value::Struct(Struct::from([("k".to_owned(), 1.into())])),
        ]);
        assert_eq!(
            serde_json::to_string(&values).unwrap(),
            r#"[null,true,-3,2.0,"NaN","12345678901","a\"b","20260102T03:04:05","AP8=",{"k":1}]"#
        );
    }
}
