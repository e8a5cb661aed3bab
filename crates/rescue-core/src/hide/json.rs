//! Serializes masked values as JSON for other programs.

use base64::Engine as _;
use serde::{Serialize, Serializer};

use super::Masked;
use ros1_master::xmlrpc::Value;

/// Serializes a value. Dates, binary data (as base64), integers beyond 32 bits, decimal numbers, infinities and NaN
/// become strings, because JSON lacks them.
impl Serialize for Masked<'_> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        Json(&self.0).serialize(to)
    }
}

/// A part of a masked value.
struct Json<'a>(&'a Value);

impl Serialize for Json<'_> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            Value::Nil => to.serialize_unit(),
            Value::Bool(truth) => to.serialize_bool(*truth),
            Value::Int(number) => to.serialize_i32(*number),
            Value::Double(number) if !number.is_finite() => to.collect_str(number),
            Value::Double(number) => to.serialize_f64(*number),
            Value::BigInt(text)
            | Value::BigDecimal(text)
            | Value::String(text)
            | Value::DateTime(text) => to.serialize_str(text),
            Value::Base64(bytes) => {
                to.serialize_str(&base64::engine::general_purpose::STANDARD.encode(bytes))
            }
            Value::Array(elements) => to.collect_seq(elements.iter().map(Json)),
            Value::Struct(members) => {
                to.collect_map(members.iter().map(|(key, value)| (key, Json(value))))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hide::Hide;
    use ros1_master::xmlrpc::Struct;

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
            serde_json::to_string(&Hide::nothing().mask("", &values)).unwrap(),
            r#"[null,true,-3,2.0,"NaN","12345678901","a\"b","20260102T03:04:05","AP8=",{"k":1}]"#
        );
    }
}
