//! Handwritten documents.

/// Contents of a `<value>`.
#[rustfmt::skip]
const VALUES: &[&str] = &[
    // Untyped and typed text.
    "", " ", "\n\t ", " a b ", "a\r\nb\rc\n\rd\r\r\ne", "&#13;", "&#xD;&#xA;&#9;",
    "a&#0000000065;b", "&#000000000000000000000065;", "&#X41;", "&#4F;", "&#x4g;", "&lt;&gt;&amp;&apos;&quot;", "&#38;lt;", "<![CDATA[<&>]]>",
    "a<![CDATA[]]]]><![CDATA[>b]]>c", "<![CDATA[a\r\nb\r]]>", "<![CDATA[]]>", "a<!-- c -->b",
    "a<!---->b", "a<?pi x?>b", "a<?pi?>b", "é € 𝄞 \u{fffd} \u{1fffe} \u{7f} \u{85}",
    "&#x10FFFF;&#xE000;&#x85;", "]]", "a]]b]>", "] ]>", "<string/>", "<string></string>",
    "<string> a </string>", "<string>a</string>b", "x<string>a</string>",
    "<string>a<b>c</b>d</string>", "<string>a<b/>d</string>", "<string>a<!-- x -->b&amp;c</string>",
    "<string a='1' b=\"2\">x</string>", "<string a = '&lt;&#10;>\n'  >x</string >", "<string\n/>",
    "<string a=''/>", "<string>&#xFFFD;</string>", "<name>n</name>",
    // Not well-formed.
    "&", "& ", "&amp", "&#;", "&#x;", "&#-5;", "&#+5;", "&#0;", "&#8;", "&#x1F;", "&#xD800;",
    "&#xFFFE;", "&#xFFFF;", "&#x110000;", "&#99999999999999999999;", "&nbsp;", "&LT;", "&a b;",
    "]]>", "a]]]>b", "<![CDATA[", "<![CDATA[a]]", "<![cdata[a]]>", "<!-- -- -->", "<!--->", "<!-->",
    "<!--x--->", "<!x>", "<!DOCTYPE a>", "<? x?>", "<?xml version='1.0'?>", "<?XML x?>", "<?xMl?>",
    "<?pi", "<?pi/?>", "<?1?>", "<?pi ??>", "<?pi?x?>", "<1>", "<>", "< string>a</string>",
    "<string", "<string a>x</string>", "<string a=1>x</string>", "<string a='1'b='2'>x</string>",
    "<string a='1' a='2'>x</string>", "<string a='<'>x</string>", "<string a='&'>x</string>",
    "<string a='&no;'>x</string>", "<string a='x>y</string>", "<string / >", "<string/ >",
    "</string>", "<string>x</strin>", "<string>x</ string>", "<string>x</string x='1'>",
    "<a><b></a></b>", "<a:b>x</a:c>", "\u{1}", "\u{b}", "\u{1f}", "\u{fffe}", "\u{ffff}",
    "<!-- \u{1} -->", "<!-- \u{ffff} -->", "<?pi \u{2}?>", "<string a='\u{3}'/>",
    "<string a='\u{fffe}'/>", "<![CDATA[\u{0}]]>", "<![CDATA[\u{ffff}]]>", "\0",
    // Documents for which quick-xml alone is, or may be, more lenient than XML.
    "<!---> -->", "<!--->-->", "<!-->-->", "<!-- - -->", "<!--- -->", "<!-x-->", "<??>", "<?>",
    "<?>?>", "<?? ?>", "<![CDATA[]>]]>", "<![CDATA[>]]>", "<![CDATA[]]]>", "<![CDATA[]]]]>",
    "<![ CDATA[]]>", "<![]]>", "<a'>'>x</a'>'>", "<string><a/b></a/b></string>",
    "<string><a\"/></string>", "<string><a;/></string>", "<string><-a/></string>",
    "<string><.a/></string>", "<string><_a.-:1></_a.-:1 \r\n></string>", "<//>", "</>", "<//a>",
    "<string></string/>", "<string></string a='>'>", "<string></string\">\"",
    "<string></string\u{a0}>", "<string a='/'/>", "<string a='>'/>", "<string a='\"'/>",
    "<string a=/>", "<string a='1'/ >", "<string ='1'/>", "<string a==''/>", "<string a='' =''/>",
    "<string a='''/>", "<string a\n=\r'x'/>", "<string a='1'\u{c}b='2'/>",
    "<string a='1'\u{a0}b='2'/>", "<string a/b='1'/>", "<string a<b='1'/>", "<string 1='1'/>",
    "<string a='' '/>", "<string a='&#8;'/>", "<string a='&#xFFFE;'/>", "<string a='&#65'/>",
    "<string a=';'/>", "<string a='&lt'/>", "<string a='&;'/>",
    "<string a='&#x41;&#65;\r\n\t]]>'/>", "<string a='a' b='a' aa='a' c='a'/>",
    "<string a='b' b='a'c='a'/>", "&;", "&#", "&# 65;", "&#65 ;", "& amp;", "&amp ;", "&amp&amp;",
    "&#x4_1;", "&#٣;", "a\u{85}b\u{2028}c", "&lt;]]&gt;", "]]&#62;", "]]<!---->>",
    // Numbers.
    "<int>5</int>", "<int> 5 </int>", "<int>\n+5\t</int>", "<int>-0</int>", "<int>007</int>",
    "<int></int>", "<int/>", "<int> </int>", "<int>+</int>", "<int>- 5</int>", "<int>1 2</int>",
    "<int>--5</int>", "<int>1_000</int>", "<int>1__0</int>", "<int>_1</int>", "<int>1_</int>",
    "<int>-_1</int>", "<int>0x10</int>", "<int>1e3</int>", "<int>1.0</int>", "<int>1L</int>",
    "<bigdecimal>1.5</bigdecimal>", "<bigdecimal>-0.25</bigdecimal>", "<bigdecimal>100</bigdecimal>",
    "<int>٣</int>", "<int>-٣1\u{ff15}</int>", "<double>٣.٥</double>", "<int>٣x</int>", "<int>é</int>", "<int>\u{666}\u{66a}</int>",
    "<int>2147483647</int>", "<int>2147483648</int>", "<int>-2147483648</int>",
    "<int>-2147483649</int>", "<int>-00002147483649</int>", "<int>0_0</int>",
    "<int>5<!-- x -->6</int>", "<int>&#53;</int>", "<i1>300</i1>", "<i2>70000</i2>", "<i4>-1</i4>",
    "<i8>9223372036854775808</i8>", "<biginteger>123456789012345678901234567890</biginteger>",
    "<i16>1</i16>", "<I4>1</I4>", "<double>1</double>", "<double> 1.5 </double>",
    "<double>1.</double>", "<double>.5</double>", "<double>.</double>", "<double></double>",
    "<double>1e5</double>", "<double>1E+05</double>", "<double>e5</double>", "<double>1e</double>",
    "<double>1_0.0_1e1_0</double>", "<double>1_.0</double>", "<double>1._0</double>",
    "<double>1_e5</double>", "<double>_1</double>", "<double>nan</double>", "<double>-NaN</double>",
    "<double>+nan</double>", "<double>inf</double>", "<double>-Infinity</double>",
    "<double>infinit</double>", "<double>n_an</double>", "<double>1e999</double>",
    "<double>-1e999</double>", "<double>1e-999</double>", "<double>-0</double>",
    "<double>-0.0e-99999999999</double>", "<double>0x1p3</double>", "<double>1,5</double>",
    "<double>1d5</double>", "<double>+ 1</double>", "<double>2.2250738585072011e-308</double>",
    "<double>4.9e-324</double>", "<double>2e-324</double>",
    "<double>1.7976931348623159e308</double>", "<double>9007199254740993</double>",
    "<double>0.1e1e1</double>", "<float>2.5</float>", "<double>nan(1)</double>",
    // Booleans, nil, dates, binary data.
    "<boolean>0</boolean>", "<boolean>1</boolean>", "<boolean> 1 </boolean>",
    "<boolean>true</boolean>", "<boolean></boolean>", "<boolean>01</boolean>",
    "<boolean>2</boolean>", "<nil/>", "<nil></nil>", "<nil>x</nil>", "<ex:nil/>",
    "<ex:i4>5</ex:i4>", "<a:b:int>5</a:b:int>", "<:int>5</:int>", "<int:>5</int:>",
    "<dateTime.iso8601>20240101T00:00:00</dateTime.iso8601>", "<dateTime.iso8601/>",
    "<dateTime.iso8601> \n x &lt; y \u{a0}\u{3000}\u{85}</dateTime.iso8601>",
    "<datetime.iso8601>x</datetime.iso8601>", "<base64>QUJD</base64>",
    "<base64>\nQU\n JD\n</base64>", "<base64/>", "<base64>QQ==</base64>", "<base64>QQ=</base64>",
    "<base64>QQ</base64>", "<base64>Q</base64>", "<base64>QUI=</base64>", "<base64>QUI</base64>",
    "<base64>Q=Q=</base64>", "<base64>QQ==QUJD</base64>", "<base64>QQ=Q=</base64>",
    "<base64>QQ=QQ</base64>", "<base64>=QUJD</base64>", "<base64>====</base64>",
    "<base64>Q===</base64>", "<base64>QU=J=D=</base64>", "<base64>QUI=QUI=</base64>",
    "<base64>QUJD*-_!</base64>", "<base64>é</base64>", "<base64>QUJDQ</base64>",
    "<base64>QUJDQ=</base64>",
    // Arrays and structs, well-formed or not.
    "<array/>", "<array><data/></array>", "<array><data></data></array>",
    "<array><value>a</value></array>", "<array> a <data> b <value>c</value> d </data> e </array>",
    "<array><int>1</int><string>x</string></array>",
    "<array><data><value/><value> </value></data></array>",
    "<x:array><data><value>a</value></data></x:array>", "<data><value>1</value></data>",
    "<foo>1</foo>", "<foo/>", "<param/>", "<params/>", "<member/>", "<array><foo>1</foo></array>",
    "<array><foo><value>1</value></foo></array>", "<value>x</value>",
    "<value><value><int>1</int></value></value>", "<value/>", "<int>1</int><int>2</int>",
    "<string><int>1</int></string>", "<int><string>1</string></int>",
    "<int>1<string>x</string></int>", "<struct/>", "<struct></struct>",
    "<struct><member><name>a</name><value>1</value></member></struct>",
    "<struct><member><name>b</name><value>1</value></member><member><name>a</name><value>2</value></member><member><name>b</name><value>3</value></member></struct>",
    "<struct><member><name>a</name></member></struct>",
    "<struct><member><value>1</value></member></struct>",
    "<struct><member><value>1</value><name>a</name></member></struct>",
    "<struct><name>a</name><value>1</value></struct>",
    "<struct><member><name/><value/></member></struct>",
    "<struct><member><name> a </name><value>1</value></member></struct>",
    "<struct><member><name>a</name><value>1</value><value>2</value></member></struct>",
    "<struct><member><name>a/b</name><value><array><data><value>1</value></data></array></value></member></struct>",
    "<struct><value>k</value><value>v</value></struct>",
    "<struct><member><name>a&amp;<![CDATA[<]]></name><value/></member></struct>",
    "<struct><member><name>a</name><value><nil/></value></member></struct>",
    "<struct><array/><value>1</value></struct>", "<struct><struct/><value>1</value></struct>",
    "<bigdecimal>x</bigdecimal>", "<methodName>other</methodName>", "<fault/>",
];

/// Contents of `<params>`.
#[rustfmt::skip]
const PARAMS: &[&str] = &[
    "", "<param/>", "<param><value/></param><param><value><int>1</int></value></param>",
    "<int>1</int>", "text", "<value>a</value>", "<param>text</param>",
    "<param><value>a</value><value>b</value></param>", "<params/>", "<param><int>1</int></param>",
    "<foo><bar/></foo>", "<string>a</string>b<string>c</string>",
];

/// Whole documents.
#[rustfmt::skip]
const DOCUMENTS: &[&str] = &[
    "", " ", "x", "<", "<a", "<a>", "<a/>", "<?xml version='1.0'?>", "<methodCall/>",
    "<methodName/>", "<methodName>m</methodName>",
    "<methodCall><methodName>m</methodName></methodCall>",
    "<methodCall><methodName> m\n</methodName><params/></methodCall>",
    "<methodCall><params/></methodCall>",
    "<methodCall><params/><methodName>m</methodName></methodCall>",
    "<methodCall><methodName>a</methodName><methodName>b</methodName><params/></methodCall>",
    "<methodCall><methodName>m<x/>n</methodName></methodCall>",
    "<methodCall><methodName><x>m</x>n</methodName></methodCall>",
    "<methodCall><methodName>m</methodName><params><param><value>1</value></param></params><params><param><value>2</value></param></params></methodCall>",
    "<methodCall><methodName>m</methodName><params/><fault/></methodCall>",
    "<methodCall><methodName>m</methodName><fault/><params/></methodCall>",
    "<methodCall><methodName>m</methodName><params/></methodCall>x",
    "<methodCall><methodName>m</methodName><params/></methodCall><a/>",
    "<methodCall><methodName>m</methodName><params/></methodCall> \r\n\t",
    "<methodCall><methodName>m</methodName><params/></methodCall>\0",
    "<methodCall><methodName>m</methodName><params/></methodCall><!-- x --><?y z?>",
    "<methodCall><methodName>m</methodName><params/></methodCall>&#32;",
    "<methodCall><methodName>m</methodName><params/></methodCall><![CDATA[]]>",
    "<methodCall><methodName>m</methodName><params/></methodCall><!DOCTYPE a>",
    " \n<methodCall><methodName>m</methodName></methodCall>",
    "<!-- x --><?y?><methodCall><methodName>m</methodName></methodCall>",
    "x<methodCall><methodName>m</methodName></methodCall>", "&#32;<methodName>m</methodName>",
    "<![CDATA[]]><methodName>m</methodName>", " <?xml version='1.0'?><methodName>m</methodName>",
    "\n<?xml version='1.0'?><methodName>m</methodName>",
    "<?xml version='1.0'?><?xml version='1.0'?><methodName>m</methodName>",
    "\u{feff}<?xml version='1.0'?><methodName>m</methodName>", "\u{feff}<methodName>m</methodName>",
    "\u{feff}\u{feff}<methodName>m</methodName>", "<methodName>\u{feff}m</methodName>",
    "<?xml version=\"1.0\"?>\r\n<methodName>m</methodName>",
    "<?xml version='1.1'?><methodName>m</methodName>",
    "<?xml version='9.z-_'?><methodName>m</methodName>",
    "<?xml version=''?><methodName>m</methodName>",
    "<?xml version='1 0'?><methodName>m</methodName>",
    "<?xml version='1+0'?><methodName>m</methodName>", "<?xml?><methodName>m</methodName>",
    "<?xml ?><methodName>m</methodName>", "<?xml version='1.0' ?><methodName>m</methodName>",
    "<?xml version='1.0'encoding='utf-8'?><methodName>m</methodName>",
    "<?xml\nversion = '1.0'\tencoding\r=\n\"utf-8\" standalone='yes' ?><methodName>m</methodName>",
    "<?xml encoding='utf-8'?><methodName>m</methodName>",
    "<?xml encoding='utf-8' version='1.0'?><methodName>m</methodName>",
    "<?xml version='1.0' standalone='no'?><methodName>m</methodName>",
    "<?xml version='1.0' standalone='maybe'?><methodName>m</methodName>",
    "<?xml version='1.0' standalone='yes' encoding='utf-8'?><methodName>m</methodName>",
    "<?xml version='1.0' x='y'?><methodName>m</methodName>",
    "<?xml version='1.0' version='1.0'?><methodName>m</methodName>",
    "<?xml version='1.0\"?><methodName>m</methodName>",
    "<?xml version='1.0'><methodName>m</methodName>",
    "<?xml version='1.0' encoding=''?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='1'?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='-'?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='UTF-8'?><methodName>é</methodName>",
    "<?xml version='1.0' encoding='uTf-8'?><methodName>é</methodName>",
    "<?xml version='1.0' encoding='US-ASCII'?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='us-ascii'?><methodName>é</methodName>",
    "<?xml version='1.0' encoding='ISO-8859-1'?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='no-such'?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='utf-16'?><methodName>m</methodName>",
    "<?xml version='1.0' encodinG='utf-8'?><methodName>m</methodName>",
    "<?xml-stylesheet x?><methodName>m</methodName>", "<?xmlx?><methodName>m</methodName>",
    "<?xml version='1.0' é='1'?><methodName>m</methodName>",
    "<x:methodCall><x:methodName>m</x:methodName><x:params/></x:methodCall>",
    "<methodCall xmlns='u' xmlns:x='v' x:y='z'><methodName>m</methodName></methodCall>",
    "<?xml version='1.0'?> <?xml version='1.0'?><methodName>m</methodName>",
    "\u{feff}<!-- --><?xml version='1.0'?><methodName>m</methodName>",
    "\u{feff}\u{feff}<?xml version='1.0'?><methodName>m</methodName>",
    "\u{feff} <methodName>m</methodName>", "\u{feff}", "\u{feff}x",
    "<?xml version='&#49;.0'?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='UTF-8\" standalone='yes'?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='utf-8' encoding='utf-8'?><methodName>m</methodName>",
    "<?xml version='1.0' standalone='yes' standalone='yes'?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='utf-8'standalone='yes'?><methodName>m</methodName>",
    "<?xml version='1.0' standalone=''?><methodName>m</methodName>",
    "<?xml version='1.0'\u{a0}?><methodName>m</methodName>",
    "<?xml version='1.0' encoding?><methodName>m</methodName>",
    "<?xml version='1.0' encoding='&#85;TF-8'?><methodName>m</methodName>",
    "<?xml/?><methodName>m</methodName>", "<?xml", "<?xml ", "<?xml version='1.0'", "<?", "<!",
    "</", "<!-", "<![", "<methodName>m</methodName></methodName>", "</a><methodName>m</methodName>",
    "\u{a0}<methodName>m</methodName>", "<methodName>m</methodName>\u{85}",
    "<methodName>m</methodName>&", "<methodName>m</methodName>]]>", "<methodName>m</methodName><",
    "<!DOCTYPE a [<!ENTITY b 'c'>]><methodName>&b;</methodName>",
    "<!DOCTYPE><methodName>m</methodName>", "<!doctype a><methodName>m</methodName>",
    "<html><body>503</body></html>", "{\"a\": 1}", "<methodName>m</methodName >",
    "<?xml version='1.0' encoding='latin1'?><a>é&no;</a>", "<?xml version='1.0' encoding='iso-8859-1'?><a>éé</b>",
    "<?xml version='1.0' encoding='latin1'?><a>é", "<?xml version='1.0' encoding='utf-8'?><a>é",
    "<?xml version='1.0' encoding='utf-8'?><a>é&no;</a>", "<a>é&no;</a>",
    "<methodName>m</methodName", "<a><methodName>m</methodName>", "<methodName>m</", "<methodName>m</methodName ",
    "{}", " \n{}", "<?xml version='1.0'?>{}", "<methodName>m</methodName>{}", "<methodName>m</methodName>\n }", "[1]",
    "!a", "$a", "*a", "+a", "/a", ";a", "=a", "?a", "@a", "\\a", "^a", "`a", "~a", "\u{7f}a", "(a", "|a", "1a", "-a", "%a", "#a",
    "<!ENTITY a 'b'><methodName>m</methodName>", "\n<!ATTLIST a><methodName>m</methodName>",
    "<?xml version='1.0'?><!ELEMENT a ANY><methodName>m</methodName>", "<!ELEMENT><methodName>m</methodName>",
    "<!E1 a><methodName>m</methodName>", "<!a b", "<!a ", "<!a", "<methodName>m</methodName><!ENTITY a 'b'>",
    "<a/><!ENTITY a 'b'><b/>",
];

/// A call with `inside` between `<params>` and `</params>`.
pub(crate) fn params(inside: &str) -> Vec<u8> {
    format!("<?xml version='1.0'?><methodCall><methodName>m</methodName><params>{inside}</params></methodCall>")
        .into_bytes()
}

/// A call with one parameter, which has `inside` between `<value>` and `</value>`.
pub(crate) fn value(inside: &str) -> Vec<u8> {
    params(&format!("<param><value>{inside}</value></param>"))
}

/// Documents that CPython and this decoder must treat alike.
pub(crate) fn odd_documents() -> Vec<Vec<u8>> {
    let mut documents = Vec::new();
    for inside in VALUES {
        documents.push(value(inside));
    }
    for inside in PARAMS {
        documents.push(params(inside));
    }
    for document in DOCUMENTS {
        documents.push(document.as_bytes().to_vec());
    }
    for bytes in [
        &b"<?xml version='1.0' encoding='iso-8859-1'?><methodName>\xe9\x80\xff\x85</methodName>"[..],
        b"<methodName>\xe9</methodName>",
        b"<methodName>\xc0\x80</methodName>",
        b"<methodName>\xed\xa0\x80</methodName>",
        b"<methodName>\xf4\x90\x80\x80</methodName>",
        b"<methodName>\xf0\x9d\x84</methodName>",
        b"<methodName>m</methodName>\xff",
        b"<?xml version='1.0' encoding='us-ascii'?><methodName>\x80</methodName>",
        b"<?xml version='1.0' encoding='utf-8'?><!-- \xff --><methodName>m</methodName>",
        b"<methodName>m</methodName\x00>",
        b"\xff\xfe",
    ] {
        documents.push(bytes.to_vec());
    }
    for name in [
        "utf8",
        "Utf_8",
        "ascii",
        "latin1",
        "LATIN-1",
        "latin_1",
        "iso8859-1",
        "ISO_8859-1",
        "iso8859_1",
        "L1",
        "cp1252",
        "Windows-1252",
    ] {
        documents.push(declared(name));
    }
    for text in [
        DECLARED,
        "<methodName>é€𝄞\u{1}</methodName>",
        "<methodName>é€𝄞</methodName>",
        "\u{feff}<a/>",
        "<a",
    ] {
        documents.push(utf16_of(text, &[0xff, 0xfe]));
        let big = text.encode_utf16().flat_map(u16::to_be_bytes);
        documents.push([0xfe, 0xff].into_iter().chain(big).collect());
    }
    for name in ["utf-16", "UTF-16", "utf-8"] {
        let text = String::from_utf8(declared(name)).unwrap();
        documents.push(utf16_of(&text, &[0xff, 0xfe]));
    }
    for (name, bytes) in [
        ("latin1", &b"\xe9\x80"[..]),
        ("utf8", "é".as_bytes()),
        ("ascii", b"\x80"),
    ] {
        let document = format!("<?xml version='1.0' encoding='{name}'?><methodName>");
        documents.push([document.as_bytes(), bytes, b"</methodName>"].concat());
    }
    for names in [31, 32, 33, 100] {
        let many: String = (0..names).map(|n| format!(" a{n}='x'")).collect();
        documents.push(params(&format!("<param{many}/>")));
        documents.push(params(&format!("<param{many} a30=''/>")));
    }
    let digits = |n: usize| format!("<int>{}</int>", "9".repeat(n));
    documents.push(value(&digits(4300)));
    documents.push(value(&digits(4301)));
    documents.push(value(&format!("<int>{}1</int>", "0".repeat(4299))));
    documents.push(value(&format!("<int>{}1</int>", "0".repeat(4300))));
    documents.push(value(&format!("<int>-{}1</int>", "1_".repeat(4299))));
    documents.push(value(&format!("<int>-{}1</int>", "1_".repeat(4300))));
    documents.push(value(&format!("<double>{}</double>", "9".repeat(5000))));
    documents.push(value(&format!("<double>0.{}1</double>", "0".repeat(5000))));
    documents.push(value(&format!(
        "<double>{}e-5000</double>",
        "9".repeat(5000)
    )));
    for depth in [100, 511, 512] {
        let (open, close) = ("<array><data><value>", "</value></data></array>");
        documents.push(value(&(open.repeat(depth) + "x" + &close.repeat(depth))));
        let open = "<struct><member><name>k</name><value>";
        let close = "</value></member></struct>";
        documents.push(value(&(open.repeat(depth) + "x" + &close.repeat(depth))));
    }
    documents
}

const DECLARED: &str = "<?xml version='1.0'?><methodName>m</methodName>";

/// A document that names its encoding.
fn declared(name: &str) -> Vec<u8> {
    format!("<?xml version='1.0' encoding='{name}'?><methodName>m</methodName>").into_bytes()
}

/// `text` in UTF-16, little end first, after a byte order mark.
fn utf16_of(text: &str, mark: &[u8]) -> Vec<u8> {
    let units = text.encode_utf16().flat_map(u16::to_le_bytes);
    mark.iter().copied().chain(units).collect()
}

/// Documents that CPython accepts and this decoder refuses, so that rosrescue only forwards them.
pub(crate) fn refused_documents() -> Vec<(&'static str, Vec<u8>)> {
    vec![
        (
            "a document type",
            b"<!DOCTYPE methodCall><methodName>m</methodName>".to_vec(),
        ),
        (
            "a document type",
            b"<!DOCTYPE a SYSTEM 'x'><methodName>m</methodName>".to_vec(),
        ),
        ("UTF-16 without a byte order mark", utf16_of(DECLARED, &[])),
        ("an 8-bit encoding", declared("koi8-r")),
        (
            "an 8-bit encoding",
            [declared("cp1252"), b"<!-- \xe9 -->".to_vec()].concat(),
        ),
        (
            "a byte order mark with another encoding",
            [b"\xef\xbb\xbf".to_vec(), declared("ISO-8859-1")].concat(),
        ),
        (
            "a byte order mark with another encoding",
            [b"\xef\xbb\xbf".to_vec(), declared("US-ASCII")].concat(),
        ),
        ("a non-ASCII name", params("<é/>")),
        ("a non-ASCII name", params("<aé/>")),
        ("a non-ASCII name", params("<a é='1'/>")),
        ("a non-ASCII name", params("<?é x?>")),
        ("a non-ASCII space", value("<int>5\u{a0}</int>")),
        (
            "a digit that Python 2 does not know",
            value("<int>\u{de7}</int>"),
        ),
        (
            "a digit beyond the first plane",
            value("<int>\u{1d7d0}</int>"),
        ),
        (
            "a bigdecimal with an exponent",
            value("<bigdecimal>1e5</bigdecimal>"),
        ),
        (
            "a name that is not a string",
            value("<struct><int>1</int><value>x</value></struct>"),
        ),
        (
            "a name that is not a string",
            value("<struct><nil/><value>x</value></struct>"),
        ),
        (
            "more than 512 levels",
            value(&("<array>".repeat(513) + &"</array>".repeat(513))),
        ),
        (
            "more than 2048 open elements",
            params(&("<x>".repeat(2050) + &"</x>".repeat(2050))),
        ),
    ]
}
