"""The KRL programs, which nothing here can run: their blocks, calls, names and numbers, read as text."""

import re
from pathlib import Path

import pytest

from weldscan.devices.robots import RESPITE_S
from weldscan.devices.robots.eki import OURS
from weldscan.devices.robots.kvp import LEASE, PROGRAM
from weldscan.devices.robots.program import Command, Status

KRL = Path(__file__).resolve().parents[2] / "krl"
SOURCES = sorted(KRL.glob("*.src"))
MOVING = [KRL / f"weldscan_{link}.src" for link in ("kvp", "eki", "serial")]
BLOCKS = {
    "DEF": "END",
    "DEFFCT": "ENDFCT",
    "IF": "ENDIF",
    "LOOP": "ENDLOOP",
    "WHILE": "ENDWHILE",
    "FOR": "ENDFOR",
    "SWITCH": "ENDSWITCH",
    "REPEAT": "UNTIL",
}


def lines(path):
    """Statements without comments."""
    for line in path.read_text(encoding="ascii").splitlines():
        code = re.sub(r'("[^"]*")|;.*', lambda found: found[1] or "", line).strip()
        if code and not code.startswith("&"):
            yield code


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_blocks_are_closed(path):
    opened = []
    for line in lines(path):
        word = line.removeprefix("GLOBAL ").split()[0].split("(")[0]
        if word == "WAIT":
            continue
        if word in BLOCKS:
            assert word != "IF" or line.endswith("THEN"), line
            opened.append(BLOCKS[word])
        elif word in BLOCKS.values():
            assert opened.pop() == word, line
    assert opened == []


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_what_is_called_is_there(path):
    whole = "\n".join(lines(path))
    shared = "\n".join(lines(KRL / "weldscan_drive.src"))
    there = set(re.findall(r"\bDEF(?:FCT \w+)? (\w+)\(", whole))
    there |= set(re.findall(r"GLOBAL DEF(?:FCT \w+)? (\w+)\(", shared))
    assert path.stem.upper() in there
    for name in re.findall(r"\b(WELDSCAN_\w+)\s*\(", whole):
        assert name in there
        assert len(name) <= 24  # the longest name that KRL takes


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_variables_are_declared(path):
    """Every name that is assigned or compared: declared in the same routine or in the module's list of data."""
    data = path.with_suffix(".dat")
    shared = data.read_text() if data.exists() else ""
    known = set(re.findall(r"DECL (?:GLOBAL )?\w+ (\w+)", shared))
    for routine in re.split(r"(?m)^(?:GLOBAL )?DEF(?:FCT \w+)? ", "\n".join(lines(path)))[1:]:
        own = {
            name for found in re.findall(r"DECL \w+ ([\w,\[\]]+)", routine) for name in re.findall(r"[A-Z]\w*", found)
        }
        for name in re.findall(r"(?m)^([A-Z]\w*)(?:\.\w+|\[[^\]]*\])?=(?!=)", routine):
            assert name in known | own, name


def functions_that_report(path):
    """Assignments of a return value, with the statement that follows each."""
    code = list(lines(path))
    return [(line, code[number + 1]) for number, line in enumerate(code) if re.match(r"RET=(EKI|RSI)_", line)]


def test_every_return_value_is_looked_at():
    found = functions_that_report(KRL / "weldscan_eki.src") + functions_that_report(KRL / "weldscan_rsi.src")
    assert len(found) > 70
    for line, following in found:
        assert re.match(r"IF RET(\.Msg_No>0|<>RSIOK) THEN|WELDSCAN_(GOT|SAID|CLEARED)\( \)", following), line


def test_elements_are_those_of_the_configuration():
    text = (KRL / "weldscan_eki.src").read_text()
    for side, verb in ((OURS.receive, "Get"), (OURS.send, "Set")):
        tags = re.findall(rf'EKI_{verb}(Int|Real)\("WeldscanEki","([\w/@]+)"', text)
        assert [tag for _, tag in tags] == ["/".join((*e.path, f"@{e.attribute}")) for e in side]
    cleared = re.findall(r'EKI_ClearBuffer\("WeldscanEki","([\w/@]+)"', text)
    assert cleared == ["/".join((*e.path, f"@{e.attribute}")) for e in OURS.receive]


@pytest.mark.parametrize("path", MOVING, ids=lambda path: path.stem)
def test_motion(path):
    """One PTP apart from block coincidence: to what INVERSE gave, behind a look, under an interrupt that brakes."""
    code = "\n".join(lines(path))
    shared = "\n".join(lines(KRL / "weldscan_drive.src"))
    assert re.findall(r"(?m)^(?:PTP|LIN|CIRC).*", code) == ["PTP JOINTS"]
    assert re.findall(r"(?m)^(?:PTP|LIN|CIRC).*", shared) == ["PTP $AXIS_ACT"]
    guard = re.search(r"(?m)^IF ([^\n]*) THEN\nPTP JOINTS\nWAIT SEC 0$", code)[1]
    assert "$TIMER_FLAG[16]==FALSE" in guard
    assert "$MODE_OP==#T1" in guard
    assert "INTERRUPT DECL 20 WHEN $TIMER_FLAG[16]==TRUE DO WELDSCAN_LOST( )" in code
    assert "INTERRUPT DECL 3 WHEN $STOPMESS==TRUE DO IR_STOPM( )" in code
    assert code.index("INTERRUPT ON 20") < code.index("PTP JOINTS")
    assert f"$TIMER[16]={round(-1000 * RESPITE_S)}" in code
    assert "INVERSE(GOAL,HERE,FAILED)" in shared
    assert "BAS(#VEL_PTP,10)" in shared
    assert "$LOAD=" in shared
    for axis in range(1, 7):
        assert f"(JOINTS.A{axis}<$SOFTN_END[{axis}]) OR (JOINTS.A{axis}>$SOFTP_END[{axis}])" in shared


def test_numbers_are_those_of_the_client():
    assert f"DEF {PROGRAM}( )" in (KRL / "weldscan_kvp.src").read_text()
    assert f"{LEASE}=" in (KRL / "weldscan_kvp.src").read_text()
    for link in ("eki", "serial"):
        text = (KRL / f"weldscan_{link}.dat").read_text()
        commands = re.search(r"COMMAND=0 +; (.*)", text)[1]
        assert re.findall(r"(\d) ", commands) == [str(int(command)) for command in Command]
        statuses = re.search(r"STATUS=0 +; (.*)", text)[1]
        told = [word.split(" ", 1) for word in statuses.split(", ")]
        assert [(int(code), name) for code, name in told] == [
            (int(status), status.name.lower().replace("_", " ").replace("not in t1", "not in T1")) for status in Status
        ]


def test_serial_port_and_its_traps():
    code = "\n".join(lines(KRL / "weldscan_serial.src"))
    assert set(re.findall(r":SER_\d", code)) == {":SER_3"}
    assert "WHILE HANDLE==0" in code
    assert "%c" not in code
    assert "#DATA_OK" in code
    assert not re.search(r'"[^"]*%[^"]* [^"]*"', code)  # no blank within what is read or written


def test_rsi_names_its_context_as_rsi_4_does():
    assert 'RSI_CREATE("WeldscanRsi",' in (KRL / "weldscan_rsi.src").read_text()
