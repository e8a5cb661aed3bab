//! One test for each special case. `tests/codec` checks the same cases against CPython.

use super::number::repr;
use super::{
    Call, DecodeError, MAX_DEPTH, Python, Reply, Struct, Value, decode_call, decode_call_for,
    decode_reply, encode_call, encode_reply,
};

/// The only parameter of a call with `inside` between `<value>` and `</value>`.
fn decoded(inside: &str) -> Result<Value, DecodeError> {
    let body = format!(
        "<methodCall><methodName>m</methodName><params><param><value>{inside}</value></param>\
         </params></methodCall>"
    );
    let mut params = decode_call(body.as_bytes())?.params;
    assert_eq!(params.len(), 1);
    Ok(params.remove(0))
}

fn value(inside: &str) -> Value {
    decoded(inside).unwrap()
}

fn text(text: &str) -> Value {
    Value::from(text)
}

fn is_syntax(inside: &str) -> bool {
    matches!(decoded(inside), Err(DecodeError::Syntax { .. }))
}

fn is_bad(inside: &str) -> bool {
    matches!(decoded(inside), Err(DecodeError::BadText { .. }))
}

#[test]
fn untyped_text_is_a_string_and_keeps_its_white_space() {
    assert_eq!(value(""), text(""));
    assert_eq!(value(" \n a\t "), text(" \n a\t "));
    assert_eq!(value("<string/>"), text(""));
    assert_eq!(value("<string> a </string>\n"), text(" a "));
}

#[test]
fn line_ends_become_line_feeds_unless_written_as_references() {
    assert_eq!(value("a\r\nb\rc\r\r\n"), text("a\nb\nc\n\n"));
    assert_eq!(value("<![CDATA[a\r\nb\r]]>"), text("a\nb\n"));
    assert_eq!(value("a&#13;&#xA;b"), text("a\r\nb"));
}

/// A master's values contain these characters as they are in its reply.
#[test]
fn a_decoded_reply_keeps_the_characters_that_cpython_does_not_escape() {
    let date = |text: &str| Value::DateTime(text.to_owned());
    for value in [
        text("a\r\nb\rc\r\r\n"),
        Value::Struct(Struct::from([(
            "\r\n".to_owned(),
            Value::Array(vec![text("\r")]),
        )])),
        date("a&amp;b&#13;c\rd > e"),
        date("&lt;a/&gt;"),
        text("a&amp;b&#13;"),
    ] {
        let reply = Reply::Value(value);
        assert_eq!(decode_reply(&encode_reply(&reply)), Ok(reply));
    }
    for broken in ["a<b", "a & b", "]]>", "&nbsp;"] {
        assert!(decode_reply(&encode_reply(&Reply::Value(date(broken)))).is_err());
    }
}

#[test]
fn text_is_joined_across_references_cdata_sections_and_comments() {
    assert_eq!(
        value("a&lt;<![CDATA[<&]]]]><!-- c --><?p i?>&#x1F600;b"),
        text("a<<&]]\u{1f600}b")
    );
}

#[test]
fn xml_that_is_not_well_formed_is_refused() {
    for inside in [
        "a & b",
        "&nbsp;",
        "&#0;",
        "&#xD800;",
        "&#+65;",
        "]]>",
        "\u{1}",
        "\u{ffff}",
        "<!-- -- -->",
        "<string></b>",
        "<string b='1' b='2'/>",
        "<string b='<'/>",
        "<string b=1/>",
        "<string b='1'c='2'/>",
        "<?xml version='1.0'?>",
        "<![CDATA[",
    ] {
        assert!(is_syntax(inside), "{inside}");
    }
    for document in [
        "",
        "<a>",
        "<a/><b/>",
        "<a/>x",
        "x<a/>",
        " <?xml version='1.0'?><a/>",
    ] {
        let error = decode_call(document.as_bytes()).unwrap_err();
        assert!(
            matches!(error, DecodeError::Syntax { .. }),
            "{document}: {error}"
        );
    }
}

#[test]
fn a_document_type_is_refused() {
    let document = b"<!DOCTYPE a [<!ENTITY b 'c'>]><methodName>&b;</methodName>";
    let error = decode_call(document).unwrap_err();
    assert!(
        matches!(error, DecodeError::Unsupported { at: 0, .. }),
        "{error}"
    );
}

#[test]
fn text_is_read_in_the_encoding_that_the_document_declares() {
    let method = |document: &[u8]| decode_call(document).map(|call| call.method);
    let latin = b"<?xml version='1.0' encoding='iso-8859-1'?><methodName>\xe9</methodName>";
    assert_eq!(method(latin), Ok("é".to_owned()));
    let marked = "\u{feff}<?xml version=\"1.0\" encoding=\"UTF-8\"?><methodName>é</methodName>";
    assert_eq!(method(marked.as_bytes()), Ok("é".to_owned()));
    assert!(matches!(
        method(b"<methodName>\xe9</methodName>"),
        Err(DecodeError::NotText {
            at: 12,
            encoding: "UTF-8"
        })
    ));
    assert!(matches!(
        method("<?xml version='1.0' encoding='us-ascii'?><methodName>é</methodName>".as_bytes()),
        Err(DecodeError::NotText {
            encoding: "US-ASCII",
            ..
        })
    ));
    let declared =
        |name: &str| format!("<?xml version='1.0' encoding='{name}'?><methodName>m</methodName>");
    for name in ["utf8", "LATIN-1", "windows-1252"] {
        assert_eq!(
            method(declared(name).as_bytes()),
            Ok("m".to_owned()),
            "{name}"
        );
    }
    let units = "<methodName>é𝄞</methodName>".encode_utf16();
    let utf16: Vec<u8> = [0xfe, 0xff]
        .into_iter()
        .chain(units.flat_map(u16::to_be_bytes))
        .collect();
    assert_eq!(method(&utf16), Ok("é𝄞".to_owned()));
    for broken in [utf16.split_last().unwrap().1, b"\xff\xfe\0\xd8"] {
        assert!(
            matches!(method(broken), Err(DecodeError::Encoding { .. })),
            "{broken:?}"
        );
    }
    assert_eq!(
        method(b"<?xml version='1.0' encoding='koi8-r'?><methodName>m</methodName>"),
        Err(DecodeError::Encoding {
            name: "koi8-r".to_owned()
        })
    );
}

#[test]
fn integers_are_read_as_python_reads_them() {
    for (inside, number) in [
        ("5", 5),
        (" +5\n", 5),
        ("-0", 0),
        ("007", 7),
        ("1_000", 1000),
    ] {
        assert_eq!(value(&format!("<i4>{inside}</i4>")), Value::Int(number));
    }
    assert_eq!(value("<int>-\u{661}0\u{ff19}</int>"), Value::Int(-109));
    for tag in ["i1", "i2", "i4", "i8", "int", "biginteger", "ex:i8"] {
        assert_eq!(
            value(&format!("<{tag}>-2147483648</{tag}>")),
            Value::Int(i32::MIN)
        );
    }
    assert_eq!(
        value("<i8> -002_147483649</i8>"),
        Value::BigInt("-2147483649".to_owned())
    );
    for inside in [
        "", " ", "1__0", "_1", "1_", "0x1", "1.0", "1e3", "- 1", "+-1",
    ] {
        assert!(is_bad(&format!("<int>{inside}</int>")), "{inside}");
    }
    assert_eq!(
        value(&format!("<int>{}</int>", "9".repeat(4300))),
        Value::BigInt("9".repeat(4300))
    );
    assert!(is_bad(&format!("<int>{}</int>", "0".repeat(4301))));
}

#[test]
fn doubles_are_read_as_python_reads_them() {
    for (inside, number) in [
        (" 1_0.5e0_1 ", 105.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("-0", -0.0),
        ("1e999", f64::INFINITY),
        ("-Infinity", f64::NEG_INFINITY),
        ("-NaN", f64::NAN),
    ] {
        assert_eq!(
            value(&format!("<double>{inside}</double>")),
            Value::Double(number)
        );
    }
    for inside in ["", ".", "1_.5", "0x1p3", "1e", "n_an"] {
        assert!(is_bad(&format!("<double>{inside}</double>")), "{inside}");
    }
}

#[test]
fn only_0_and_1_are_booleans() {
    assert_eq!(value("<boolean>1</boolean>"), Value::Bool(true));
    for inside in ["true", " 1", "", "2"] {
        assert!(is_bad(&format!("<boolean>{inside}</boolean>")), "{inside}");
    }
}

#[test]
fn base64_is_read_leniently() {
    let bytes = |inside: &str| decoded(&format!("<base64>{inside}</base64>"));
    for inside in ["QUI=", "\nQU\nI=\n", "Q*U-I=", "QUI=QUJD", "=QUI="] {
        assert_eq!(bytes(inside), Ok(Value::Base64(b"AB".to_vec())), "{inside}");
    }
    for inside in ["Q", "QUI", "Q===", "é"] {
        assert!(
            matches!(bytes(inside), Err(DecodeError::BadText { .. })),
            "{inside}"
        );
    }
}

#[test]
fn a_date_is_kept_as_text_without_surrounding_white_space() {
    let date = value("<dateTime.iso8601>\u{a0} any <!-- c -->&lt; \n</dateTime.iso8601>");
    assert_eq!(date, Value::DateTime("any <".to_owned()));
}

#[test]
fn a_repeated_struct_member_keeps_its_first_place_and_its_last_value() {
    let members = value(
        "<struct><member><name>b</name><value>1</value></member>\
         <member><name>a</name><value>2</value></member>\
         <member><name>b</name><value>3</value></member></struct>",
    );
    let expected = [("b", "3"), ("a", "2")].map(|(name, value)| (name.to_owned(), text(value)));
    assert_eq!(members, Value::Struct(Struct::from(expected)));
}

#[test]
fn a_struct_pairs_names_and_values_in_turn_however_they_are_nested() {
    let expected = Value::Struct(Struct::from([("a".to_owned(), text("1"))]));
    for inside in [
        "<name>a</name><value>1</value>",
        "<value>a</value><value>1</value>",
        "<member><value>a</value></member><foo><string>1</string></foo>",
    ] {
        assert_eq!(value(&format!("<struct>{inside}</struct>")), expected);
    }
    assert!(is_bad("<struct><name>a</name></struct>"));
    assert!(matches!(
        decoded("<struct><int>1</int><value>x</value></struct>"),
        Err(DecodeError::Unsupported { .. })
    ));
}

#[test]
fn an_unknown_element_is_refused_only_directly_inside_a_value() {
    assert!(matches!(
        decoded("<ex:serializable>1</ex:serializable>"),
        Err(DecodeError::UnknownType { tag, .. }) if tag == "serializable"
    ));
    assert_eq!(value("<string>a<b>c</b>d</string>"), text("cd"));
    assert_eq!(
        value("<array><foo><value>1</value></foo></array>"),
        Value::Array(vec![text("1")])
    );
}

/// Measured with Python 2.7.11 and 2.7.15.
#[test]
fn python_2_knows_fewer_types_and_before_2_7_12_ignores_the_elements_of_others() {
    let count_for = |inside: &str, micro: u32| {
        let body = format!("<methodName>m</methodName><params><value>{inside}</value></params>");
        let body = format!("<methodCall>{body}</methodCall>");
        let python = Python::new(2, 7, micro);
        decode_call_for(body.as_bytes(), python).map(|call| call.params.len())
    };
    let count = |inside: &str| count_for(inside, 11);
    for ignored in [
        "i1",
        "i2",
        "biginteger",
        "float",
        "bigdecimal",
        "ex:int",
        "unknown",
    ] {
        assert_eq!(
            count(&format!("<{ignored}>1</{ignored}>")),
            Ok(0),
            "{ignored}"
        );
        let refused = count_for(&format!("<{ignored}>1</{ignored}>"), 15);
        let is_refused =
            matches!(&refused, Err(DecodeError::UnknownType { tag, .. }) if tag == ignored);
        assert!(is_refused, "{refused:?}");
    }
    for known in ["i4", "i8", "int", "double", "string", "boolean", "nil"] {
        assert_eq!(count(&format!("<{known}>1</{known}>")), Ok(1), "{known}");
    }
    assert!(count("<int>1_000</int>").is_err());
    assert!(count("<double>1_0.5</double>").is_err());
}

#[test]
fn each_version_of_python_words_its_faults_in_its_own_way() {
    let [two, old, new] =
        [(2, 7), (3, 6), (3, 11)].map(|(major, minor)| Python::new(major, minor, 15));
    for (inside, python, fault) in [
        (
            "<int>five</int>",
            two,
            "<type 'exceptions.ValueError'>:invalid literal for int() with base 10: 'five'",
        ),
        (
            "<i1>1</i1>",
            two,
            "<class 'xmlrpclib.ResponseError'>:ResponseError(\"unknown tag u'i1'\",)",
        ),
        (
            "<no>1</no>",
            new,
            "<class 'xmlrpc.client.ResponseError'>:ResponseError(\"unknown tag 'no'\")",
        ),
        (
            "<int> five </int>",
            two,
            "<type 'exceptions.ValueError'>:invalid literal for int() with base 10: 'five '",
        ),
        (
            "<int> five </int>",
            new,
            "<class 'ValueError'>:invalid literal for int() with base 10: ' five '",
        ),
        (
            "<int> </int>",
            two,
            "<type 'exceptions.ValueError'>:invalid literal for int() with base 10: ' '",
        ),
        (
            "<double>five</double>",
            two,
            "<type 'exceptions.ValueError'>:could not convert string to float: five",
        ),
        (
            "<double> 1,5 </double>",
            two,
            "<type 'exceptions.ValueError'>:invalid literal for float(): 1,5 ",
        ),
        (
            "<double>1,5</double>",
            new,
            "<class 'ValueError'>:could not convert string to float: '1,5'",
        ),
        (
            "<boolean>2</boolean>",
            two,
            "<type 'exceptions.TypeError'>:bad boolean value",
        ),
        (
            "<base64>A</base64>",
            two,
            "<class 'binascii.Error'>:Incorrect padding",
        ),
        (
            "<base64>A</base64>",
            old,
            "<class 'binascii.Error'>:Incorrect padding",
        ),
        (
            "<base64>AAAA\nA</base64>",
            new,
            "<class 'binascii.Error'>:Invalid base64-encoded string: number of data characters (5) cannot be 1 more than a multiple of 4",
        ),
        (
            "<base64>AA</base64>",
            new,
            "<class 'binascii.Error'>:Incorrect padding",
        ),
        (
            "<string>1</int>",
            two,
            "<class 'xml.parsers.expat.ExpatError'>:mismatched tag: line 1, column 38",
        ),
    ] {
        let body = format!("<methodCall><params><value>{inside}</value></params></methodCall>");
        let error = decode_call_for(body.as_bytes(), python).unwrap_err();
        assert_eq!(
            error.fault(body.as_bytes(), python).as_deref(),
            Some(fault),
            "{inside}"
        );
    }
}

/// A small document must not fill the memory. CPython's values share one text.
#[test]
fn a_text_that_many_elements_repeat_is_refused() {
    let repeated = |text: &str, times| {
        let (open, close) = ("<string>".repeat(times), "</string>".repeat(times));
        decode_call(
            format!("<methodCall><methodName>m</methodName>{open}{text}{close}</methodCall>")
                .as_bytes(),
        )
    };
    assert_eq!(repeated("ab", 3).unwrap().params, vec![text("ab"); 3]);
    let refused = repeated(&"x".repeat(32 << 10), 1900);
    assert!(
        matches!(refused, Err(DecodeError::Unsupported { .. })),
        "{:?}",
        refused.map(|call| call.params.len())
    );
}

#[test]
fn a_call_has_the_last_method_name_and_all_values() {
    let call = decode_call(
        b"<x><methodName>a</methodName><int>1</int><params><value>2</value></params>\
          <methodName> b </methodName></x>",
    );
    assert_eq!(call, Ok(Call::new(" b ", vec![Value::Int(1), text("2")])));
    for document in [
        "<a/>",
        "<params/>",
        "<a><methodName>m</methodName><fault/></a>",
    ] {
        let error = decode_call(document.as_bytes()).unwrap_err();
        assert!(
            matches!(error, DecodeError::Shape { wanted: "call", .. }),
            "{error}"
        );
    }
}

#[test]
fn a_reply_has_exactly_one_value_or_a_complete_fault() {
    let fault = Reply::Fault {
        code: -3,
        text: "<class 'X'>:\u{e9} & so on".to_owned(),
    };
    assert_eq!(decode_reply(&encode_reply(&fault)), Ok(fault));
    for document in [
        "<params/>",
        "<params><value/><value/></params>",
        "<value/>",
        "<fault/>",
        "<fault><value>x</value></fault>",
        "<fault><value><struct/></value></fault>",
    ] {
        let error = decode_reply(document.as_bytes()).unwrap_err();
        assert!(
            matches!(
                error,
                DecodeError::Shape {
                    wanted: "reply",
                    ..
                }
            ),
            "{error}"
        );
    }
}

#[test]
fn values_may_nest_as_deep_as_the_limit_and_no_deeper() {
    let tower = |levels| "<array><value>".repeat(levels) + &"</value></array>".repeat(levels);
    assert!(decoded(&tower(MAX_DEPTH)).is_ok());
    assert!(matches!(
        decoded(&tower(MAX_DEPTH + 1)),
        Err(DecodeError::TooDeep {
            limit: MAX_DEPTH,
            ..
        })
    ));
}

#[test]
fn a_call_to_a_master_is_encoded_compactly() {
    let members = Struct::from([("k".to_owned(), Value::Struct(Struct::new()))]);
    let call = Call::new(
        "m",
        vec![
            text(""),
            text(" <&>\r"),
            Value::Int(-1),
            Value::BigInt("2147483648".to_owned()),
            Value::Bool(true),
            Value::Double(1e16),
            Value::Nil,
            Value::Base64(vec![0; 60]),
            Value::DateTime("a<".to_owned()),
            Value::Array(Vec::new()),
            Value::Struct(members),
        ],
    );
    let values = [
        "",
        " &lt;&amp;&gt;&#13;",
        "<i4>-1</i4>",
        "<i8>2147483648</i8>",
        "<boolean>1</boolean>",
        "<double>1e+16</double>",
        "<nil/>",
        &format!("<base64>{}</base64>", "A".repeat(80)),
        "<dateTime.iso8601>a&lt;</dateTime.iso8601>",
        "<array><data></data></array>",
        "<struct><member><name>k</name><value><struct></struct></value></member></struct>",
    ];
    let params: String = values
        .iter()
        .map(|value| format!("<param><value>{value}</value></param>"))
        .collect();
    let expected = format!(
        "<?xml version=\"1.0\"?><methodCall><methodName>m</methodName>\
         <params>{params}</params></methodCall>"
    );
    let written = encode_call(&call);
    assert_eq!(String::from_utf8_lossy(&written), expected);
    assert_eq!(decode_call(&written), Ok(call));
}

#[test]
fn a_reply_is_encoded_in_cpythons_layout() {
    let members = Struct::from([("a&b".to_owned(), Value::Base64(vec![0; 58]))]);
    let elements = vec![Value::Int(1), text("<\r>"), Value::Struct(members)];
    let written = encode_reply(&Reply::Value(Value::Array(elements)));
    let line = "A".repeat(76);
    let expected = format!(
        "<?xml version='1.0'?>\n<methodResponse>\n<params>\n<param>\n<value><array><data>\n\
         <value><int>1</int></value>\n<value><string>&lt;\r&gt;</string></value>\n\
         <value><struct>\n<member>\n<name>a&amp;b</name>\n\
         <value><base64>\n{line}\nAA==\n</base64></value>\n</member>\n</struct></value>\n\
         </data></array></value>\n</param>\n</params>\n</methodResponse>\n"
    );
    assert_eq!(String::from_utf8_lossy(&written), expected);
}

#[test]
fn a_value_that_rosmaster_cannot_return_becomes_its_fault() {
    let big = Value::BigInt("2147483648".to_owned());
    let fault = |value| decode_reply(&encode_reply(&Reply::Value(value)));
    let of = |text: &str| {
        Ok(Reply::Fault {
            code: 1,
            text: text.to_owned(),
        })
    };
    assert_eq!(
        fault(Value::Array(vec![Value::Nil, big.clone()])),
        of("<class 'TypeError'>:cannot marshal None unless allow_none is enabled")
    );
    assert_eq!(
        fault(big),
        of("<class 'OverflowError'>:int exceeds XML-RPC limits")
    );
    let deep = (0..493).fold(Value::Nil, |value, _| Value::Array(vec![value]));
    assert_eq!(
        fault(deep),
        of("<class 'RecursionError'>:maximum recursion depth exceeded")
    );
}

#[test]
fn doubles_are_written_as_python_writes_them() {
    for (number, text) in [
        (0.0, "0.0"),
        (-0.0, "-0.0"),
        (1.0, "1.0"),
        (-120.0, "-120.0"),
        (0.1, "0.1"),
        (1e-4, "0.0001"),
        (-0.00012, "-0.00012"),
        (1e-5, "1e-05"),
        (1.5e-7, "1.5e-07"),
        (1e15, "1000000000000000.0"),
        (9_999_999_999_999_998.0, "9999999999999998.0"),
        (1e16, "1e+16"),
        (1.25e100, "1.25e+100"),
        (5e-324, "5e-324"),
        (f64::MAX, "1.7976931348623157e+308"),
        (f64::NAN, "nan"),
        (f64::INFINITY, "inf"),
        (f64::NEG_INFINITY, "-inf"),
        // These numbers are halfway between two texts of the shortest length, which end in 0.2 and 0.3.
        (f64::from_bits(0x4307_6b26_abd3_448a), "823967287502993.2"),
    ] {
        assert_eq!(repr(number), text);
    }
}
