"""What a shell's script runs at a TAB, beside tyro's part; it is copied into the scripts as it is.

No backslashes, dollars or imports here: the text stands within the quotes of three shells.
"""


def offered(words, index, spec, known, complete):  # type: ignore[no-untyped-def]
    """Return what may stand at a place of the command line; FILES, where nothing is known of it.

    Args:
        words: the command line, the program first.
        index: the place.
        spec: what tyro knows of the verbs.
        known: by verb, the words that may follow an option; under "" those that take the place
            of an argument, for every verb that has any.
        complete: tyro's completion.

    """
    files = ["__TYRO_COMPLETE_FILES__"]
    current = words[index] if index < len(words) else ""
    own = known.get(words[1], {}) if index > 1 else {}
    before = words[index - 1]
    if before and before in own:
        found = own[before]
    else:
        found = complete(words, index, spec)
        if "" in own and found != files and not current.startswith("-"):
            # options would stand in the way of the names of folders
            found = [one for one in found if not one.startswith("-")]
            if not set(own[""]) & set(words):
                found = found + own[""]
    return [one for one in found if one.startswith(current)] or files
