"""Run many clips: each an ordinary run in ``OUT/<id>``, any number of processes and machines at work on them at a time.

``command.run_batch`` does all of it. ``clips`` says what there is to do; the ``scheduler`` of every process takes what is open and
nobody has (``records``, and ``Claims`` of ``common.files``) and gives it to an engine (``work``): ``embedded``, or ``on_ray``. What
belongs to clips is in ``run_clip`` and ``page``; the rest does any work.
"""
