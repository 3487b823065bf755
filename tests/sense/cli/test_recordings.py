import json
from pathlib import Path

from sense import Recording, export_csv


def test_csv_comes_in(padforge_sense, recording: Recording) -> None:
    export_csv(recording, "r.csv")
    code, out, _ = padforge_sense("import", "r.csv")
    assert code == 0
    assert out.endswith(" -> out/r/recording\n")
    assert Recording.open("out/r/recording") == recording
    start = json.loads(Path("out/r/recording/start.json").read_text())
    assert start["format"] == "padforge-recording/1"
    assert set(start["provenance"]["inputs"]) == {"r.csv"}
