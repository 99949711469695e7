"""Check the subject of a commit: conventional form, and at most 72 characters, which git and its viewers show in full.

``.pre-commit-config.yaml`` calls it with the file of the message: ``python -m data_tools.commit_subject FILE``.
``.ci/run`` calls it for new commits: ``python -m data_tools.commit_subject --since COMMIT``, on which they are based.
"""

import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

LENGTH_MAX = 72
TYPES = ("build", "chore", "ci", "docs", "feat", "fix", "merge", "perf", "refactor", "revert", "style", "test")
FORM = re.compile(rf"({'|'.join(TYPES)})(\([^()]+\))?!?: \S")
FROM_GIT = ("Merge ", 'Revert "', "fixup! ", "squash! ", "amend! ")  # subjects that git writes itself


def find_fault(subject: str) -> str | None:
    """Return what is wrong with a subject, in one line with the fix, or None."""
    if subject.startswith(FROM_GIT):
        return None
    if len(subject) > LENGTH_MAX:
        return f"the subject has {len(subject)} characters, at most {LENGTH_MAX} fit: move the rest to the body"
    if not FORM.match(subject):
        return f"the subject is not 'TYPE: ...' or 'TYPE(SCOPE): ...' with TYPE one of {', '.join(TYPES)}"
    return None


def subject_of(message: str) -> str:
    """Return the first line of a message that is neither empty nor a comment of git, or an empty string."""
    lines = (line.strip() for line in message.splitlines())
    return next((line for line in lines if line and not line.startswith("#")), "")


def subjects_since(commit: str) -> list[str]:
    """Return the subjects of the commits of this checkout that a commit does not have, without merges.

    Raises
    ------
    subprocess.CalledProcessError
        There is no such commit; git says so on stderr.
    """
    command = ["git", "log", "--no-merges", "--format=%s", f"{commit}..HEAD"]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, encoding="utf-8", check=True).stdout.splitlines()


def main(arguments: Sequence[str] | None = None) -> int:
    """Check the message in a file, or new commits; return 1, with lines on stderr, if something is wrong."""
    words = sys.argv[1:] if arguments is None else arguments
    if words[0] == "--since":
        subjects = subjects_since(words[1])
    else:
        subjects = [subject_of(Path(words[0]).read_text(encoding="utf-8"))]
    faults = [(subject, fault) for subject in subjects if (fault := find_fault(subject)) is not None]
    for subject, fault in faults:
        print(f"{subject}\n{fault}", file=sys.stderr)
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
