import json
from pathlib import Path

import scipy.io

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


def test_what_a_lab_has_comes_in_by_a_mapping(padforge_sense) -> None:
    rows = [f"{100 * i};{1 + i % 7:d},5;2;{i // 10 + 1};0;{int(i % 10 > 5)}" for i in range(30)]
    Path("lab.txt").write_text("# bench 2\nt_ms;ch1;ch2;X;Y;down\n" + "\n".join(rows))
    mapping = "time=t_ms:ms,fibres=ch*,x=X:cm,y=Y,press=down"
    code, out, err = padforge_sense("import", "lab.txt", "--map", mapping)
    assert (code, err) == (0, "")
    assert out == "3 presses, 30 readings of 2 fibres at 10.0 Hz -> out/lab/recording\n"
    recording = Recording.open("out/lab/recording")
    assert recording.presses_mm.tolist() == [[10, 0], [20, 0], [30, 0]]
    assert recording.source["mapping"] == mapping
    code, _, err = padforge_sense("import", "lab.txt", "--map", "time=t,fibres=ch*", "--out", "other")
    assert code == 2
    assert err == "padforge: lab.txt: time is 't', expected one of 't_ms', 'ch1', 'ch2', 'X', 'Y', 'down'\n"


def test_what_a_file_lacks_at_its_end_is_said(padforge_sense, recording: Recording) -> None:
    content = {"voltage": recording.readings[:391], "tim": recording.times_s[None, :391]}
    scipy.io.savemat("cut.mat", content | {"pos": recording.presses_mm[:10].T})
    note = "cut.mat: the last of 10 presses is left out, with 31 of 40 readings\n"
    code, out, err = padforge_sense("import", "cut.mat")
    assert (code, err) == (0, note)
    assert out.startswith("9 presses, 391 readings")
    assert Recording.open("out/cut/recording").source["note"] in note
    assert padforge_sense("export", "cut.mat", "cut.csv")[2] == note
    assert padforge_sense("export", "out/cut/recording", "again.csv")[2] == ""
