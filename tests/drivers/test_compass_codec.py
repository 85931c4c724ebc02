"""Tests of ``drivers.compass.codec`` with sentences of real compasses (whole, split, with errors) and random bytes."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from drivers.compass.codec import Heading, SentenceReader, encode_sentence, format_angle, parse_heading
from drivers.errors import BadFrame


class HeadingTests(SynchronousTestCase):
    def test_reads_what_compasses_send(self) -> None:
        """From sentences of real compasses, the decoder returns the heading and whether it is true or magnetic.

        The deviation in a sentence is applied.
        """
        for line, degrees, is_true in (
            (b"$HCHDG,98.3,0.0,E,12.6,W*57", 85.7, True),
            (b"$HCHDG,101.1,,,7.1,W*3C", 94.0, True),
            (b"$HCHDG,338.9, , ,0.7,W", 338.2, True),
            (b"$IIHDG,10.5,1.5,W,,", 9.0, False),
            (b"$HCHDG,350,20.0,E", 10.0, False),
            (b"$HCHDM,205.2,M", 205.2, False),
            (b"$HCHDM,205.2", 205.2, False),
            (b"$GPHDT,274.07,T*03", 274.07, True),
            (b"$IIHDT,360.0,T", 0.0, True),
            (b" $HEHDT,0.,T \t", 0.0, True),
        ):
            heading = parse_heading(line)
            assert heading is not None
            self.assertAlmostEqual(heading.degrees, degrees, 6)
            self.assertIs(heading.is_true, is_true, line)
        self.assertEqual(parse_heading(b"$HEHDT,1,T"), Heading(1.0, True, 3))

    def test_passes_over_other_sentences(self) -> None:
        """A valid sentence of a different type gives None."""
        for line in (b"$GPVTG,45.0,T,40.0,M,5.5,N,10.2,K", b"!AIVDM,1,1,,A,x,0", b"$PHDG,1.0", b"$HCHDGX,1", b"$"):
            self.assertIsNone(parse_heading(line))

    def test_refuses_what_tells_nothing(self) -> None:
        """Noise, wrong checksums, empty fields and angles out of range are refused."""
        for line in (
            *(b"", b"HCHDM,1,M", b"$HCHDM,\xb0,M", b"$HCHDM,1,M,%s" % (b"x" * 120)),
            *(b"$GPHDT,274.07,T*04", b"$GPHDT,274.07,T*", b"$GPHDT,274.07,T*031", b"$GPHDT,274.07,T*0\xff"),
            *(b"$HCHDG,,,,,", b"$HCHDM,,M", b"$HCHDM", b"$HCHDM,nan,M", b"$HCHDM,inf,M", b"$HCHDM,1e2,M"),
            *(b"$HCHDM,-1.0,M", b"$HCHDM,360.1,M", b"$HCHDM,1000,M", b"$HCHDM,1.0,T", b"$HCHDT,1.0,M"),
            *(
                b"$HCHDG,1.0,1.0,N,,",
                b"$HCHDG,1.0,1.0,,,",
                b"$HCHDG,1.0,,E,,",
                b"$HCHDG,1.0,,,181.0,W",
                b"$HCHDG,1,,,x,W",
            ),
        ):
            self.assertRaises(BadFrame, parse_heading, line)

    def test_writes_what_it_reads(self) -> None:
        """The encoder produces the same sentences as real compasses."""
        self.assertEqual(
            encode_sentence("HCHDG", "98.3", "0.0", "E", *format_angle(-12.6)), b"$HCHDG,98.3,0.0,E,12.6,W*57\r\n"
        )
        self.assertEqual(encode_sentence("GPHDT", "274.07", "T"), b"$GPHDT,274.07,T*03\r\n")


class SentenceReaderTests(SynchronousTestCase):
    def test_reads_however_it_is_cut(self) -> None:
        """Headings are read however the input is split into chunks.

        An incomplete first sentence is not an error; other invalid data is counted.
        """
        stream = (
            *(b"01.1,M*00\r\n", encode_sentence("HCHDM", "10.0", "M"), b"\r\n", encode_sentence("GPVTG", "45.0", "T")),
            *(encode_sentence("HCHDM", "20.0", "M").strip() + b"\n", b"$HCHDM,3.0,M\r\n", b"$HCHDM,40.0,M*00\r"),
            encode_sentence("HCHDT", "50.0", "T"),
        )
        for size in (1, 2, 5, 1000):
            reader, found = SentenceReader(), list[Heading]()
            data = b"".join(stream)
            for place in range(0, len(data), size):
                found += reader.read(data[place : place + size])
            self.assertEqual([heading.degrees for heading in found], [10.0, 20.0, 50.0])
            # One sentence without a checksum after sentences with checksums, and one with a wrong checksum.
            self.assertEqual((reader.bad_frames, reader.sentences), (2, 4))

    def test_takes_sentences_without_checksums(self) -> None:
        """If a compass never sends checksums, its sentences are accepted."""
        reader = SentenceReader()
        self.assertEqual(len(reader.read(b"$HCHDM,10.0,M\n$HCHDM,11.0,M\n")), 2)
        self.assertEqual(reader.bad_frames, 0)

    def test_keeps_no_endless_line(self) -> None:
        """A line above the maximum length is dropped and counted, and the next line is read."""
        reader = SentenceReader()
        for _ in range(10):
            self.assertEqual(reader.read(bytes(100)), [])
        self.assertEqual(reader.bad_frames, 5)
        self.assertEqual(len(reader.read(b"\n$HCHDM,10.0,M\n")), 1)

    @settings(max_examples=200)
    @given(st.lists(st.binary(max_size=30) | st.sampled_from([b"$HCHDG,", b"\r\n", b"1.0,E", b"*57", b"$HEHDT,1,T"])))
    def test_any_bytes(self, pieces: list[bytes]) -> None:
        """Random bytes give only valid headings, and the same ones whether the bytes arrive whole or one by one."""
        data = b"".join(pieces)
        whole, cut = SentenceReader(), SentenceReader()
        found = whole.read(data)
        self.assertTrue(all(0.0 <= heading.degrees < 360.0 for heading in found))
        in_bytes = [heading for place in range(len(data)) for heading in cut.read(data[place : place + 1])]
        if all(len(line) <= 120 for line in data.replace(b"\r", b"\n").split(b"\n")):
            self.assertEqual((found, whole.bad_frames), (in_bytes, cut.bad_frames))
