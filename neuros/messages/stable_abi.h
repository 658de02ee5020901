/* What rosidl's generated code uses of Python, in terms of its stable ABI (PEP 384): a module that
 * is compiled with this header in front runs on Python 3.10 and all later ones.
 */
#ifndef NEUROS_STABLE_ABI_H_
#define NEUROS_STABLE_ABI_H_

#define Py_LIMITED_API 0x030B0000  /* of 3.11, which has the buffer protocol in it */
#include <Python.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if PY_VERSION_HEX < 0x030B0000
/* Python 3.10 has these, the same ones, and does not yet promise to keep them. */
typedef struct {
  void * buf;
  PyObject * obj;
  Py_ssize_t len;
  Py_ssize_t itemsize;
  int readonly;
  int ndim;
  char * format;
  Py_ssize_t * shape;
  Py_ssize_t * strides;
  Py_ssize_t * suboffsets;
  void * internal;
} Py_buffer;
#define PyBUF_SIMPLE 0
int PyObject_CheckBuffer(PyObject *);
int PyObject_GetBuffer(PyObject *, Py_buffer *, int);
int PyBuffer_ToContiguous(void *, const Py_buffer *, Py_ssize_t, char);
void PyBuffer_Release(Py_buffer *);
#else
/* Here a function, which takes no PyArrayObject. */
#define Py_INCREF(object) Py_INCREF((PyObject *)(object))
#endif

#define PyBytes_AS_STRING(bytes) PyBytes_AsString(bytes)
#define PyFloat_AS_DOUBLE(number) PyFloat_AsDouble(number)
/* Names of classes and modules: ASCII, of which UTF-8 is the same. */
#define PyUnicode_1BYTE_DATA(text) PyUnicode_AsUTF8AndSize(text, NULL)
/* Of what PySequence_Fast returns, a list or a tuple. */
#undef PySequence_Fast_GET_ITEM
#define PySequence_Fast_GET_ITEM(sequence, i) \
  (PyList_Check(sequence) ? PyList_GetItem(sequence, i) : PyTuple_GetItem(sequence, i))

#endif  /* NEUROS_STABLE_ABI_H_ */
